"""Each usual mistake, planted in a healthy calibration, is found, and nothing else is called an error."""

import json

import numpy as np
import pytest
from healthy_rigs import AHEAD, HEALTHY, SIX, copy_of
from scipy.spatial.transform import Rotation

from bevcli.findings import errors_of
from bevcli.rig.checks import check_rig
from bevcli.sequences.files.calibration_file import draft_calibration

ALL = tuple(SIX["cameras"])


def report_of(document, folder):
    path = folder / "calibration.json"
    path.write_text(json.dumps(document))
    draft = draft_calibration(path)
    return check_rig(draft.rig, draft.findings)


def pose_of(entry):
    w, x, y, z = entry["rotation_wxyz"]
    return np.array(entry["translation"]), Rotation.from_quat([x, y, z, w])


def set_pose(entry, place, rotation):
    x, y, z, w = rotation.as_quat()
    entry["translation"], entry["rotation_wxyz"] = np.asarray(place).tolist(), [w, x, y, z]


# What is done to the pose of one camera, or of the bev frame: entry -> None.


def millimetres(entry):
    entry["translation"] = [1000 * value for value in entry["translation"]]


def centimetres(entry):
    entry["translation"] = [100 * value for value in entry["translation"]]


def inverted(entry):
    place, rotation = pose_of(entry)
    set_pose(entry, -rotation.inv().apply(place), rotation.inv())


def xyzw(entry):
    w, x, y, z = entry["rotation_wxyz"]
    entry["rotation_wxyz"] = [x, y, z, w]


def body_axes(entry):
    place, rotation = pose_of(entry)
    set_pose(entry, place, rotation * Rotation.from_matrix(AHEAD).inv())


def turned(axis, degrees):
    def turn(entry):
        place, rotation = pose_of(entry)
        set_pose(entry, place, rotation * Rotation.from_euler(axis, degrees, degrees=True))

    return turn


def lowered(entry):
    entry["translation"][2] -= 1.84


def far_away(entry):
    entry["translation"][0] += 20


def not_orthonormal(entry):
    rotation = pose_of(entry)[1].as_matrix()
    del entry["rotation_wxyz"]
    entry["rotation"] = (rotation * 1.01).tolist()


def left_handed(entry):
    rotation = pose_of(entry)[1].as_matrix()
    del entry["rotation_wxyz"]
    entry["rotation"] = (rotation * [-1, 1, 1]).tolist()


def rounded(entry):
    entry["rotation_wxyz"] = [round(value, 1) for value in entry["rotation_wxyz"]]


POSE_MISTAKES = [
    ("translation-unit", millimetres),
    ("translation-unit", centimetres),
    ("transform-inverted", inverted),
    ("camera-axes", body_axes),
    ("looks-at-ground", turned("x", -90)),
    ("looks-at-ground", turned("x", -60)),
    ("looks-at-ground", turned("x", -45)),
    ("looks-at-sky", turned("x", 90)),
    ("looks-at-sky", turned("x", 50)),
    ("camera-rolled", turned("z", 180)),
    ("camera-rolled", turned("z", 90)),
    ("camera-rolled", turned("z", -90)),
    ("camera-rolled", turned("z", 40)),
    ("camera-height", lowered),
    ("camera-far", far_away),
    ("rotation-not-orthonormal", not_orthonormal),
    ("rotation-left-handed", left_handed),
]


@pytest.mark.parametrize("name", HEALTHY)
def test_a_healthy_rig_gives_no_error(name, tmp_path):
    assert errors_of(report_of(copy_of(name), tmp_path).findings) == ()


def test_a_rig_like_nuscenes_gives_no_warning_and_is_near_nuscenes(tmp_path):
    report = report_of(copy_of("six"), tmp_path)
    assert [finding.code for finding in report.findings if finding.severity != "info"] == []
    assert all(measure.is_near for measure in report.measures)


def test_the_real_nuscenes_calibration_gives_no_error(shared):
    for folder in ("nuscenes-scene-0103",):
        draft = draft_calibration(shared / "data" / folder / "calibration.json")
        report = check_rig(draft.rig, draft.findings)
        assert [finding.code for finding in report.findings if finding.severity != "info"] == []


@pytest.mark.parametrize(("code", "mistake"), POSE_MISTAKES)
@pytest.mark.parametrize("camera", ALL)
def test_one_camera_with_a_mistake_is_named(code, mistake, camera, tmp_path):
    document = copy_of("six")
    mistake(document["cameras"][camera]["ego_from_camera"])
    errors = errors_of(report_of(document, tmp_path).findings)
    assert [(error.code, error.camera) for error in errors] == [(code, camera)]


@pytest.mark.parametrize(("code", "mistake"), [*POSE_MISTAKES[:16], ("quaternion-order", xyzw)])
def test_a_mistake_in_all_cameras_is_one_error(code, mistake, tmp_path):
    document = copy_of("six")
    for camera in document["cameras"].values():
        mistake(camera["ego_from_camera"])
    errors = errors_of(report_of(document, tmp_path).findings)
    assert {error.code for error in errors} == {code}
    if not code.startswith("rotation"):  # what the file itself lacks is said of each camera
        assert [error.camera for error in errors] == [None]


@pytest.mark.parametrize("camera", ["CAM_FRONT_LEFT", "CAM_FRONT_RIGHT", "CAM_BACK_LEFT", "CAM_BACK_RIGHT"])
def test_the_quaternion_order_of_one_camera(camera, tmp_path):
    """A front camera's quaternion is nearly the same in either order, a back camera's is that of one upside down."""
    document = copy_of("six")
    xyzw(document["cameras"][camera]["ego_from_camera"])
    errors = errors_of(report_of(document, tmp_path).findings)
    assert [(error.code, error.camera) for error in errors] == [("quaternion-order", camera)]


@pytest.mark.parametrize("rig", ["five", "seven", "numbered", "lorry"])
@pytest.mark.parametrize(("code", "mistake"), [*POSE_MISTAKES[:4], ("quaternion-order", xyzw)])
def test_mistakes_in_all_cameras_of_other_rigs(rig, code, mistake, tmp_path):
    document = copy_of(rig)
    for camera in document["cameras"].values():
        mistake(camera["ego_from_camera"])
    errors = errors_of(report_of(document, tmp_path).findings)
    assert {error.code for error in errors} == {code}


def test_a_rounded_quaternion_is_named_by_its_norm(tmp_path):
    document = copy_of("six")
    rounded(document["cameras"]["CAM_FRONT_LEFT"]["ego_from_camera"])
    (error,) = errors_of(report_of(document, tmp_path).findings)
    assert (error.code, error.camera) == ("quaternion-norm", "CAM_FRONT_LEFT")


def scaled(factor):
    def scale(camera):
        for row in camera["intrinsics"][:2]:
            row[:] = [factor * value for value in row]

    return scale


def transposed_size(camera):
    camera["width"], camera["height"] = camera["height"], camera["width"]


def focal(factor):
    def change(camera):
        camera["intrinsics"][0][0] *= factor
        camera["intrinsics"][1][1] *= factor

    return change


def lens(model, coefficients):
    def add(camera):
        camera["distortion"] = {"model": model, "coefficients": coefficients}

    return add


LENS_MISTAKES = [
    ("intrinsics-resolution", scaled(0.5)),
    ("intrinsics-resolution", scaled(2.0)),
    ("intrinsics-resolution", scaled(1920 / 1600)),
    ("intrinsics-resolution", scaled(1280 / 1600)),
    ("intrinsics-resolution", transposed_size),
    ("fov-implausible", focal(15)),
    ("fov-implausible", focal(0.1)),
    ("distortion-absurd", lens("brown_conrady", [-3.0, 0.0, 0.0, 0.0])),
    ("distortion-absurd", lens("brown_conrady", [0.1, 0.0, 0.9, 0.0])),
    ("distortion-absurd", lens("brown_conrady", [900.0, 0.2, 0.0, 0.0, 0.0])),
    ("distortion-absurd", lens("kannala_brandt", [-1.5, 0.0, 0.0, 0.0])),
    ("distortion-absurd", lens("kannala_brandt", [60.0, 9.0, 0.0, 0.0])),
    ("distortion-coefficients", lens("kannala_brandt", [0.1, 0.0])),
    ("distortion-model", lens("fisheye", [0.1, 0.0, 0.0, 0.0])),
]


@pytest.mark.parametrize(("code", "mistake"), LENS_MISTAKES)
@pytest.mark.parametrize("camera", ["CAM_FRONT", "CAM_BACK"])
def test_one_camera_with_a_wrong_lens_is_named(code, mistake, camera, tmp_path):
    document = copy_of("six")
    mistake(document["cameras"][camera])
    errors = errors_of(report_of(document, tmp_path).findings)
    assert [(error.code, error.camera) for error in errors] == [(code, camera)]


def test_the_resolution_that_the_intrinsics_belong_to_is_said(tmp_path):
    document = copy_of("six")
    for camera in document["cameras"].values():
        scaled(0.5)(camera)
        camera["intrinsics"][0][2], camera["intrinsics"][1][2] = 400.0, 225.0
    (error,) = errors_of(report_of(document, tmp_path).findings)
    assert error.camera is None
    assert "800 x 450" in error.message


@pytest.mark.parametrize(("a", "b"), [("FRONT_LEFT", "FRONT_RIGHT"), ("FRONT", "BACK"), ("FRONT_LEFT", "BACK_LEFT")])
def test_swapped_names_are_both_named(a, b, tmp_path):
    document = copy_of("six")
    cameras = document["cameras"]
    cameras[f"CAM_{a}"], cameras[f"CAM_{b}"] = cameras[f"CAM_{b}"], cameras[f"CAM_{a}"]
    (error,) = errors_of(report_of(document, tmp_path).findings)
    assert error.code == "swapped-names"
    assert f"CAM_{a}" in error.message
    assert f"CAM_{b}" in error.message


def test_a_front_camera_that_looks_back(tmp_path):
    document = copy_of("one")
    document["cameras"] = {"front": document["cameras"]["dashcam"]}
    place, rotation = pose_of(document["cameras"]["front"]["ego_from_camera"])
    around = Rotation.from_euler("z", 180, degrees=True)
    set_pose(document["cameras"]["front"]["ego_from_camera"], place, around * rotation)
    (error,) = errors_of(report_of(document, tmp_path).findings)
    assert (error.code, error.camera) == ("name-against-pose", "front")


def test_two_cameras_with_one_pose(tmp_path):
    document = copy_of("six")
    cameras = document["cameras"]
    cameras["CAM_BACK_LEFT"]["ego_from_camera"] = cameras["CAM_FRONT_LEFT"]["ego_from_camera"]
    (error,) = errors_of(report_of(document, tmp_path).findings)
    assert (error.code, error.camera) == ("same-pose", "CAM_BACK_LEFT")
    assert "CAM_FRONT_LEFT" in error.message


def test_an_ego_frame_with_y_forward(tmp_path):
    document = copy_of("six")
    turn = Rotation.from_euler("z", 90, degrees=True)  # ego x right, y forward: what was ahead is at 90 degrees
    for camera in document["cameras"].values():
        place, rotation = pose_of(camera["ego_from_camera"])
        set_pose(camera["ego_from_camera"], turn.apply(place), turn * rotation)
    (error,) = errors_of(report_of(document, tmp_path).findings)
    assert (error.code, error.camera) == ("ego-axes", None)


def x_forward(entry):
    entry["rotation_wxyz"] = [1.0, 0.0, 0.0, 0.0]


def on_the_ground(entry):
    entry["translation"][2] = 0.0


@pytest.mark.parametrize(
    ("code", "mistake"),
    [
        ("bev-x-forward", x_forward),
        ("bev-height", on_the_ground),
        ("translation-unit", millimetres),
        ("transform-inverted", inverted),
        ("quaternion-order", xyzw),
        ("bev-tilted", turned("x", 30)),
        ("bev-axes", turned("z", 180)),
        ("bev-far", far_away),
        ("rotation-left-handed", left_handed),
    ],
)
def test_a_wrong_bev_frame(code, mistake, tmp_path):
    document = copy_of("six")
    mistake(document["ego_from_bev"])
    errors = errors_of(report_of(document, tmp_path).findings)
    assert [(error.code, error.camera) for error in errors] == [(code, None)]


def test_a_rig_without_rear_cameras_is_warned_of_what_it_does_not_see(tmp_path):
    report = report_of(copy_of("five"), tmp_path)
    (unseen,) = [finding for finding in report.findings if finding.code == "cells-unseen"]
    assert unseen.severity == "warning"
    assert "mostly back" in unseen.found


def test_an_error_silences_what_follows_from_it(tmp_path):
    document = copy_of("six")
    for camera in document["cameras"].values():
        millimetres(camera["ego_from_camera"])
    assert [finding.code for finding in report_of(document, tmp_path).findings] == ["translation-unit"]


def test_two_mistakes_in_two_cameras_are_both_found(tmp_path):
    document = copy_of("six")
    scaled(0.5)(document["cameras"]["CAM_BACK"])
    millimetres(document["cameras"]["CAM_FRONT_LEFT"]["ego_from_camera"])
    errors = errors_of(report_of(document, tmp_path).findings)
    assert {(error.code, error.camera) for error in errors} == {
        ("intrinsics-resolution", "CAM_BACK"),
        ("translation-unit", "CAM_FRONT_LEFT"),
    }


def test_a_lorry_is_told_that_it_is_far_from_nuscenes(tmp_path):
    codes = {finding.code for finding in report_of(copy_of("lorry"), tmp_path).findings}
    assert {"height-far", "pitch-far", "fov-far"} <= codes


def test_without_ego_from_bev_the_assumption_is_said(tmp_path):
    document = copy_of("six")
    del document["ego_from_bev"]
    findings = report_of(document, tmp_path).findings
    assert [finding.severity for finding in findings if finding.code == "bev-assumed"] == ["info"]
