"""Rigs from Kalibr or ROS intrinsics and extrinsics in JSON."""

import json

import numpy as np
import pytest

from bevcli.errors import InputError
from bevcli.sequences.files.calibration_file import draft_of
from bevcli.sequences.options import RigOptions

KALIBR = """
cam0:
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 0.0002, 1.7e-05]
  distortion_model: radtan
  intrinsics: [458.6, 457.3, 367.2, 248.4]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.11]
  - [0.0, 1.0, 0.0, 0.02]
  - [0.0, 0.0, 1.0, 0.03]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [0.01, 0.02, 0.03, 0.04]
  distortion_model: equidistant
  intrinsics: [457.5, 456.1, 379.9, 255.2]
  resolution: [752, 480]
"""
ROS = """
image_width: 640
image_height: 480
camera_name: narrow
camera_matrix: {rows: 3, cols: 3, data: [500.0, 0, 320, 0, 501.0, 240, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.1, -0.2, 0.001, 0.002, 0.03]}
"""
ROS_MESSAGE = """
header: {frame_id: wide}
height: 480
width: 640
distortion_model: rational_polynomial
d: [0.1, 0.2, 0.0, 0.0, 0.1, 0.1, 0.1, 0.1]
k: [500.0, 0, 320, 0, 501.0, 240, 0, 0, 1]
"""
POSE = {"translation": [1.5, 0.0, 1.4], "rotation_wxyz": [0.5, -0.5, 0.5, -0.5]}


def read_rig(intrinsics, extrinsics):
    return draft_of(RigOptions(intrinsics=intrinsics, extrinsics=extrinsics)).rig


def write(folder, text, poses, name="intrinsics.yaml", **more):
    (folder / name).write_text(text)
    cameras = {camera: {"ego_from_camera": pose} for camera, pose in poses.items()}
    (folder / "extrinsics.json").write_text(json.dumps({"cameras": cameras, **more}))
    return folder / name, folder / "extrinsics.json"


def test_kalibr(tmp_path):
    rig = read_rig(*write(tmp_path, KALIBR, {"cam0": POSE, "cam1": POSE}, ego_from_bev=POSE))
    assert rig.names == ("cam0", "cam1")
    np.testing.assert_allclose(rig["cam0"].intrinsics, [[458.6, 0, 367.2], [0, 457.3, 248.4], [0, 0, 1]])
    assert (rig["cam0"].width, rig["cam0"].height) == (752, 480)
    assert rig["cam0"].distortion.model == "brown_conrady"
    assert rig["cam0"].distortion.coefficients == (-0.28, 0.07, 0.0002, 1.7e-05)
    assert rig["cam1"].distortion.model == "kannala_brandt"
    assert not rig.ego_from_bev_assumed
    np.testing.assert_allclose(rig.ego_from_bev[:3, 3], [1.5, 0, 1.4])


@pytest.mark.parametrize(("known", "other", "sign"), [("cam0", "cam1", 1), ("cam1", "cam0", -1)])
def test_kalibr_chain_gives_the_pose_of_the_neighbour(tmp_path, known, other, sign):
    """cam1 is 0.11 m right of cam0, 0.02 m above it and 0.03 m behind it: in ego -y, +z and -x."""
    rig = read_rig(*write(tmp_path, KALIBR, {known: POSE}))
    shift = rig[other].ego_from_camera[:3, 3] - rig[known].ego_from_camera[:3, 3]
    np.testing.assert_allclose(shift, sign * np.array([-0.03, -0.11, 0.02]), atol=1e-12)
    assert rig.ego_from_bev_assumed


def test_folder_of_ros_files(tmp_path):
    (tmp_path / "yaml").mkdir()
    (tmp_path / "yaml" / "wide.yaml").write_text(ROS_MESSAGE)
    _, extrinsics = write(tmp_path / "yaml", ROS, {"narrow": POSE, "wide": POSE}, name="a.yml")
    rig = read_rig(tmp_path / "yaml", extrinsics)
    assert set(rig.names) == {"narrow", "wide"}
    assert rig["narrow"].distortion.coefficients == (0.1, -0.2, 0.001, 0.002, 0.03)
    assert rig["wide"].distortion.coefficients == (0.1, 0.2, 0.0, 0.0, 0.1, 0.1, 0.1, 0.1)
    np.testing.assert_allclose(rig["wide"].intrinsics, [[500, 0, 320], [0, 501, 240], [0, 0, 1]])


@pytest.mark.parametrize(
    ("alias", "model"), [("radtan", "brown_conrady"), ("fisheye", "kannala_brandt"), ("equidistant", "kannala_brandt")]
)
def test_a_lens_has_the_names_of_ros_kalibr_and_opencv(tmp_path, alias, model):
    four = ROS.replace("cols: 5, data: [0.1, -0.2, 0.001, 0.002, 0.03]", "cols: 4, data: [0.1, -0.2, 0.001, 0.002]")
    for text, name in ((four.replace("plumb_bob", alias), "narrow"), (KALIBR.replace("radtan", alias), "cam0")):
        assert read(tmp_path, text, name).distortion.model == model
    none = ROS.replace("[0.1, -0.2, 0.001, 0.002, 0.03]", "[0, 0, 0, 0, 0]")
    assert read(tmp_path, none, "narrow").distortion is None


def read(folder, intrinsics, name):
    """A camera of an intrinsics file."""
    (folder / "intrinsics.yaml").write_text(intrinsics)
    pose = {"ego_from_camera": {"translation": [0, 0, 0], "rotation_wxyz": [1, 0, 0, 0]}}
    (folder / "poses.json").write_text(json.dumps({"cameras": {name: pose}}))
    return read_rig(folder / "intrinsics.yaml", folder / "poses.json")[name]


@pytest.mark.parametrize(
    ("text", "poses", "expected"),
    [
        (KALIBR.replace("radtan", "fov"), {"cam0": POSE}, "cam0: distortion_model fov"),
        (KALIBR.replace("pinhole", "omni", 1), {"cam0": POSE}, "cam0: camera_model omni"),
        (KALIBR.replace("[752, 480]", "[752]", 1), {"cam0": POSE}, "cam0.*resolution"),
        (KALIBR.replace("[458.6,", "[.nan,"), {"cam0": POSE}, "cam0.*intrinsics.*finite"),
        (KALIBR.replace("[458.6,", "[0,"), {"cam0": POSE}, "cam0.*singular"),
        (KALIBR, {"cam9": POSE}, "camera cam9: has no intrinsics"),
        (KALIBR.replace("T_cn_cnm1", "T_other"), {"cam0": POSE}, "camera cam1: its pose .* is missing"),
        (KALIBR, {"cam0": {**POSE, "rotation_wxyz": [1, 1, 0, 0]}}, "cam0.*norm"),
        ("a: [", {}, "broken YAML"),
        ("a: 1", {}, "expected .* a Kalibr camchain"),
        ("!!python/object/apply:os.getcwd []", {}, "YAML"),
    ],
)
def test_mistakes_name_file_and_camera(tmp_path, text, poses, expected):
    with pytest.raises(InputError, match=expected) as caught:
        read_rig(*write(tmp_path, text, poses))
    assert str(tmp_path) in str(caught.value)
    intrinsics, extrinsics = write(tmp_path, KALIBR, {})
    with pytest.raises(InputError, match=r"cam0: its pose .* is missing"):
        read_rig(intrinsics, None)
    with pytest.raises(InputError, match="must be given together"):
        read_rig(None, extrinsics)
    assert draft_of(RigOptions()) is None
