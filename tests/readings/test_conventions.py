"""A true drive in the conventions of other programs is read right, or a question names the options that decide."""

import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.readings.stated_drive import Convention, choices_of, opened, write, wrong

from bevcli.errors import InputError
from bevcli.sequences.open import open_sequence
from bevcli.workshop.readings import judge
from bevcli.workshop.readings.pairs import camera_pairs

STREET = Path(__file__).parents[2] / "samples/street"
CONVENTIONS = {
    "lidar of nuScenes": Convention(rig_axes="rfu", transform="T_cam_ego"),
    "north, east, down": Convention(rig_axes="frd", body="frd", rotation="quaternion", transform="T"),
    "poses of a camera to the world": Convention(body="camera", pose_transform="body_from_world"),
    "centimetres above an IMU": Convention(unit="cm", origin_m=0.55, rotation="rpy"),
    "KITTI's rows of a vehicle": Convention(file="kitti", rotation="vector", transform="T"),
    "Unity": Convention(rig_axes="ruf", camera_axes="unity"),
    "LGSVL": Convention(rig_axes="ruf", camera_axes="unity", rotation="unity"),
    "cameras of OpenGL": Convention(camera_axes="opengl", body="frd", unit="mm"),
}


@pytest.fixture(scope="module")
def street():
    return open_sequence(STREET, every=2, frames=slice(0, 3), ground_truth=False)


FAST = ("lidar of nuScenes",)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name not in FAST)) for name in CONVENTIONS]
)
def test_the_images_tell_what_files_mean(name, street, tmp_path):
    options = write(street, tmp_path, CONVENTIONS[name])
    found = opened(tmp_path, options)
    assert wrong(found, street) == ""
    assert "the images: " in " ".join(found.notes)


@pytest.mark.slow
def test_cameras_that_look_at_one_thing_tell_how_a_vehicle_that_stands_is_meant(tmp_path):
    """Direction and rotations: the question asks for the height only, which no image of one time tells."""
    truth = open_sequence(STREET, frames=slice(0, 1), ground_truth=False)
    options = write(truth, tmp_path, Convention(transform="T", rotation="vector", origin_m=0.55))
    with pytest.raises(InputError, match=r"the images do not tell its height: pass `--height 1\.5`"):
        opened(tmp_path, options)
    found = opened(tmp_path, options, height=np.mean([each.ego_from_camera[2, 3] for each in truth.rig.cameras]))
    assert wrong(found, truth) == ""
    assert re.search(r"the images: two cameras see \d\d+ points at once; .*: \d\)", " ".join(found.notes))


@pytest.mark.slow
def test_a_few_points_decide_nothing(street, tmp_path, monkeypatch):
    """At night, all that two cameras matched was one car."""
    monkeypatch.setattr(judge, "camera_pairs", lambda *drive: [
        replace(pair, rays_a=pair.rays_a[:3], rays_b=pair.rays_b[:3]) for pair in camera_pairs(*drive)])  # fmt: skip
    options = write(street, tmp_path, Convention())
    with pytest.raises(InputError, match="they show too little"):
        opened(tmp_path, options)


@pytest.mark.slow
def test_what_is_stated_is_believed_and_a_note_says_what_fits(street, tmp_path):
    options = write(street, tmp_path, Convention(rig_axes="rfu", transform="T"))
    stated = {"pose_axes": "flu", "pose_transform": "body_from_world"}
    found = opened(tmp_path, options, **stated)
    assert re.search(
        r"does not fit the images \(residual .* they fit `--pose-transform world_from_body", found.notes[-1]
    )
    assert "does not fit" not in " ".join(opened(tmp_path, options, **stated | {"pose_transform": None}).notes)


IMPOSSIBLE = r"of a point (0\.9|1\.0) m ahead", "the images fit no reading"  # of what no vehicle has as it is


def late(rows):
    return np.column_stack([rows[:, 0] + 0.15, rows[:, 1:]])


def of_a_mast(rows):
    """Of a point ahead of the vehicle's origin and above it."""
    return np.column_stack(
        [rows[:, 0], rows[:, 1:4] + Rotation.from_quat(rows[:, 4:]).apply([1.4, 0.3, 0.8]), rows[:, 4:]]
    )


def of_a_lidar(rows):
    """With x right, y forward: the rig in feet fits better than poses of the vehicle."""
    body = Rotation.from_quat(rows[:, 4:])
    return np.column_stack(
        [
            rows[:, 0],
            rows[:, 1:4] + body.apply([0.94, 0, 1.84]),
            (body * Rotation.from_euler("z", -np.pi / 2)).as_quat(),
        ]
    )


def swapped(rows):
    return rows[:, [0, 2, 1, 3, 4, 5, 6, 7]]


def without_scale(rows):
    return np.column_stack([rows[:, 0], 0.37 * rows[:, 1:4], rows[:, 4:]])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "stated", "told"),
    [
        (late, {}, r"if the poses are (149|150|151) ms earlier"),
        (of_a_mast, {}, r"of a point 1\.\d m ahead"),
        (without_scale, {"rig_unit": "m"}, r"0\.3\d of the ways"),
        (of_a_lidar, {}, IMPOSSIBLE[0]),
        (swapped, {}, IMPOSSIBLE[1]),
    ],
)
def test_poses_that_would_fit_much_better_otherwise_are_refused(change, stated, told, tmp_path):
    drive = open_sequence(STREET, every=2, frames=slice(0, 8), ground_truth=False)
    options = write(drive, tmp_path, Convention())
    poses = options["ego_motion_file"]
    np.savetxt(poses, change(np.loadtxt(poses)), fmt="%.9f")
    with pytest.raises(InputError, match=told):
        opened(tmp_path, options, **stated)
    if told not in IMPOSSIBLE:
        opened(tmp_path, options, image_check=False, pose_axes="flu", pose_transform="world_from_body", rig_unit="m")


@pytest.mark.slow
@pytest.mark.parametrize(
    "lens", [{"D": [-0.3, 0.1, 0, 0, 0]}, {"D": [0.05, 0.01, 0, 0], "distortion_model": "equidistant"}]
)
def test_a_lens_of_rectified_images_is_refused(lens, tmp_path):
    drive = open_sequence(STREET, every=2, frames=slice(0, 8), ground_truth=False)
    options = write(drive, tmp_path, Convention())
    rig = json.loads(options["calibration"].read_text())
    options["calibration"].write_text(json.dumps({name: camera | lens for name, camera in rig.items()}))
    with pytest.raises(InputError, match="if the images are rectified, without the lens distortion"):
        opened(tmp_path, options)


def answered(folder, options, **stated):
    """The drives that all answers to the questions of a drive lead to."""
    try:
        return [opened(folder, options, **stated)]
    except InputError as asked:
        question = asked
    answers = choices_of(question)
    assert answers, f"{question} names no option that decides ({stated})"
    assert all(answer.keys() - stated.keys() for answer in answers), f"{question} asks again ({stated})"
    return [found for answer in answers for found in answered(folder, options, **stated, **answer)]


@pytest.mark.parametrize(("convention", "stated"), [
    pytest.param(Convention(rig_axes="frd", body="frd", origin_m=0.55), {}, marks=pytest.mark.slow),
    (Convention(rig_axes="frd", body="frd"), {"image_check": False}),
    (Convention(transform="T", unit="cm", file="yaw"), {}),
    pytest.param(
        Convention(rig_axes="rfu", body="camera", pose_transform="body_from_world"), {}, marks=pytest.mark.slow),
])  # fmt: skip
def test_without_images_each_answer_goes_on_and_one_is_right(convention, stated, street, tmp_path):
    """At night, or where the images are not compared."""
    options = write(street, tmp_path, convention)
    black = cv2.imencode(".jpg", np.zeros((450, 800, 3), np.uint8))[1].tobytes()
    for path in (tmp_path / "drive/images").rglob("*.jpg"):
        path.write_bytes(black)
    with pytest.raises(InputError, match="images are not compared" if stated else "they show too little"):
        opened(tmp_path, options, **stated)
    results = [wrong(found, street) for found in answered(tmp_path, options, **stated)]
    assert results.count("") >= 1
