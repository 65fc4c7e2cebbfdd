"""Each common mistake, planted in a healthy calibration, is found, and is the only error."""

import json

import mistakes as made
import pytest
from healthy_rigs import HEALTHY, SIX, copy_of
from scipy.spatial.transform import Rotation

from bevcli.errors import errors_of
from bevcli.rig import check_calibration
from bevcli.rig.check_calibration import check_rig
from bevcli.sequences.files.calibration_file import draft_calibration

ALL = tuple(SIX["cameras"])
OTHERS = [name for name in ALL if name != "CAM_BACK"]


def report_of(document, folder):
    path = folder / "calibration.json"
    path.write_text(json.dumps(document))
    draft = draft_calibration(path)
    return check_rig(draft.rig, draft.findings)


def errors_in(document, folder):
    """The errors of a rig with a mistake. Beside errors its coverage is not reported, and is not computed here."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(check_calibration, "coverage_of", lambda rig: None)
        return errors_of(report_of(document, folder).findings)


@pytest.mark.parametrize("name", HEALTHY)
def test_a_healthy_rig_gives_no_error(name, tmp_path):
    assert errors_of(report_of(copy_of(name), tmp_path).findings) == ()


OF_ONE_CAMERA = [*made.POSE_MISTAKES, ("rotation-twice", made.both_rotations)]
# A front camera's quaternion is nearly the same in either order, a back camera's is that of one upside down.
XYZW = [(name, "quaternion-order", made.xyzw) for name in ALL if name.endswith(("LEFT", "RIGHT"))]


@pytest.mark.parametrize(
    ("camera", "code", "mistake"),
    [
        *(("CAM_BACK", *each) for each in OF_ONE_CAMERA),
        *XYZW,
        ("CAM_FRONT_LEFT", "quaternion-norm", made.rounded),
        *(pytest.param(name, *each, marks=pytest.mark.slow) for name in OTHERS for each in OF_ONE_CAMERA),
    ],
)
def test_one_camera_with_a_mistake_is_named(code, mistake, camera, tmp_path):
    document = copy_of("six")
    mistake(document["cameras"][camera]["ego_from_camera"])
    errors = errors_in(document, tmp_path)
    assert [(error.code, error.camera) for error in errors] == [(code, camera)]


OF_OTHER_RIGS = [
    pytest.param(rig, *mistake, marks=[pytest.mark.slow] * (rig != "lorry"))
    for rig in ("lorry", "five", "seven", "numbered")
    for mistake in (*made.POSE_MISTAKES[:4], ("quaternion-order", made.xyzw))
]


@pytest.mark.parametrize(
    ("rig", "code", "mistake"),
    [*(("six", *each) for each in made.POSE_MISTAKES[:16]), ("six", "quaternion-order", made.xyzw), *OF_OTHER_RIGS],
)
def test_a_mistake_in_all_cameras_is_one_error(rig, code, mistake, tmp_path):
    document = copy_of(rig)
    for camera in document["cameras"].values():
        mistake(camera["ego_from_camera"])
    errors = errors_in(document, tmp_path)
    assert {error.code for error in errors} == {code}
    if rig == "six" and not code.startswith("rotation"):  # mistakes in the file itself are findings on each camera
        assert [error.camera for error in errors] == [None]
    if code == "translation-unit":  # consequences of an error are suppressed
        assert [finding.code for finding in report_of(document, tmp_path).findings] == [code]


@pytest.mark.parametrize(("code", "mistake"), [*made.LENS_MISTAKES, *made.FIELD_MISTAKES])
@pytest.mark.parametrize("camera", ["CAM_FRONT", pytest.param("CAM_BACK", marks=pytest.mark.slow)])
def test_one_camera_with_a_wrong_lens_is_named(code, mistake, camera, tmp_path):
    document = copy_of("six")
    mistake(document["cameras"][camera])
    errors = errors_in(document, tmp_path)
    assert [(error.code, error.camera) for error in errors] == [(code, camera)]


@pytest.mark.parametrize(("code", "mistake"), made.LENS_WARNINGS)
def test_an_unusual_lens_is_a_warning(code, mistake, tmp_path):
    document = copy_of("six")
    mistake(document["cameras"]["CAM_FRONT"])
    findings = report_of(document, tmp_path).findings
    assert (code, "warning", "CAM_FRONT") in {(found.code, found.severity, found.camera) for found in findings}


def test_the_message_names_the_image_size_of_the_intrinsics(tmp_path):
    document = copy_of("six")
    for camera in document["cameras"].values():
        made.scaled(0.5)(camera)
        camera["intrinsics"][0][2], camera["intrinsics"][1][2] = 400.0, 225.0
    (error,) = errors_in(document, tmp_path)
    assert error.camera is None
    assert "800 x 450" in error.message


@pytest.mark.parametrize(("a", "b"), [("FRONT_LEFT", "FRONT_RIGHT"), ("FRONT", "BACK"), ("FRONT_LEFT", "BACK_LEFT")])
def test_the_message_names_both_swapped_cameras(a, b, tmp_path):
    document = copy_of("six")
    cameras = document["cameras"]
    cameras[f"CAM_{a}"], cameras[f"CAM_{b}"] = cameras[f"CAM_{b}"], cameras[f"CAM_{a}"]
    (error,) = errors_in(document, tmp_path)
    assert error.code == "swapped-names"
    assert f"CAM_{a}" in error.message
    assert f"CAM_{b}" in error.message


def test_cameras_with_one_pose_or_one_against_its_name(tmp_path):
    document = copy_of("six")
    cameras = document["cameras"]
    cameras["CAM_BACK_LEFT"]["ego_from_camera"] = cameras["CAM_FRONT_LEFT"]["ego_from_camera"]
    (error,) = errors_in(document, tmp_path)
    assert (error.code, error.camera) == ("same-pose", "CAM_BACK_LEFT")
    assert "CAM_FRONT_LEFT" in error.message
    document = copy_of("one")
    document["cameras"] = {"front": document["cameras"]["dashcam"]}
    place, rotation = made.pose_of(document["cameras"]["front"]["ego_from_camera"])
    around = Rotation.from_euler("z", 180, degrees=True)
    made.set_pose(document["cameras"]["front"]["ego_from_camera"], place, around * rotation)
    (error,) = errors_in(document, tmp_path)
    assert (error.code, error.camera) == ("name-against-pose", "front")


def test_an_ego_frame_with_y_forward(tmp_path):
    document = copy_of("six")
    turn = Rotation.from_euler("z", 90, degrees=True)  # ego x right, y forward: what was ahead is at 90 degrees
    for camera in document["cameras"].values():
        place, rotation = made.pose_of(camera["ego_from_camera"])
        made.set_pose(camera["ego_from_camera"], turn.apply(place), turn * rotation)
    (error,) = errors_in(document, tmp_path)
    assert (error.code, error.camera) == ("ego-axes", None)


@pytest.mark.parametrize(("code", "mistake"), made.BEV_MISTAKES)
def test_a_wrong_bev_frame(code, mistake, tmp_path):
    document = copy_of("six")
    mistake(document["ego_from_bev"])
    errors = errors_in(document, tmp_path)
    assert [(error.code, error.camera) for error in errors] == [(code, None)]
    del document["ego_from_bev"]
    findings = report_of(document, tmp_path).findings
    assert [finding.severity for finding in findings if finding.code == "bev-assumed"] == ["info"]


def test_two_mistakes_in_two_cameras_are_both_found(tmp_path):
    document = copy_of("six")
    made.scaled(0.5)(document["cameras"]["CAM_BACK"])
    made.millimetres(document["cameras"]["CAM_FRONT_LEFT"]["ego_from_camera"])
    errors = errors_in(document, tmp_path)
    assert {(error.code, error.camera) for error in errors} == {
        ("intrinsics-resolution", "CAM_BACK"),
        ("translation-unit", "CAM_FRONT_LEFT"),
    }


def test_swapped_cameras_are_found_where_all_poses_are_inverted(tmp_path):
    document = copy_of("six")
    cameras = document["cameras"]
    for entry in cameras.values():
        made.inverted(entry["ego_from_camera"])
    front, back = cameras["CAM_FRONT"], cameras["CAM_BACK_LEFT"]
    front["ego_from_camera"], back["ego_from_camera"] = back["ego_from_camera"], front["ego_from_camera"]
    errors = errors_in(document, tmp_path)
    assert {error.code for error in errors} == {"transform-inverted", "swapped-names"}
    swapped = next(error for error in errors if error.code == "swapped-names")
    assert "CAM_FRONT and CAM_BACK_LEFT are swapped" in swapped.message
    assert swapped.advice.endswith("after correcting the poses")
    inverse = next(error for error in errors if error.code == "transform-inverted")
    assert all(name in inverse.message for name in cameras)
