"""Faults that show without labels: on points and images made by hand, and on a rendered drive."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import planted_faults
import pytest
from scipy.spatial.transform import Rotation

from bevcli.errors import Finding
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import Camera, CameraRig
from bevcli.geometry.transforms import inverse, rigid, rotation_about_z
from bevcli.inference.load import load_model
from bevcli.workshop.formats.pose_readings import Poses
from bevcli.workshop.synth.drives import RenderedDrives
from bevcli.workshop.synth.rig import nuscenes_like_rig
from bevcli.workshop.trust.camera_faults import Mistake, Points, Side, camera_findings, misfits, share
from bevcli.workshop.trust.faults import (
    find_faults,
    image_findings,
    model_faults,
    one_cause,
    repeated,
)

RIG: CameraRig = nuscenes_like_rig(512, 288)
SECOND = 1_000_000_000
COUNT = 20  # points of a camera in a step
# A vehicle that turns and accelerates: seven poses, two a second.
TIMES = np.arange(7) * SECOND // 2
YAWS = np.array([0, 0.05, 0.14, 0.3, 0.4, 0.45, 0.47])
XS, YS = np.array([0, 2, 4.5, 7.5, 11, 14, 16.0]), np.array([0, 0, 0.4, 1.3, 2.8, 4.2, 5.2])
ROWS = Poses(TIMES, np.stack(list(map(rotation_about_z, YAWS))), np.column_stack([XS, YS, 0 * XS]))


def seen(camera: Camera, rows: Poses = ROWS, shift: int = 0) -> Points:
    """Points of a camera in five steps; with a shift, those that it showed some steps before."""
    random, rays = np.random.default_rng(0), ([], [])
    poses, steps = rows.at(TIMES)[0], np.arange(1, 6)
    for step in steps.tolist():
        places = random.uniform((0, 0), (camera.width, camera.height), (COUNT, 2))
        ahead = camera.rays(places) * random.uniform(6, 40, (COUNT, 1))
        first, second = (pose @ camera.ego_from_camera for pose in poses[step - shift : step + 2 - shift])
        motion = inverse(second) @ first
        then = ahead @ motion[:3, :3].T + motion[:3, 3]
        for side, points in zip(rays, (ahead, then), strict=True):
            side.append(points / np.linalg.norm(points, axis=1, keepdims=True))
    sides = (Side(camera, np.concatenate(each), TIMES[steps + later]) for later, each in enumerate(rays))
    return Points((camera.name, camera.name), *sides, np.repeat(np.arange(5), COUNT))


def stated(points: Points, camera: Camera) -> Points:
    """The points if a camera of another calibration is stated to have taken the images."""
    name = points.names[0]
    return replace(Mistake("", "", "", {name: camera}).undone(points), names=(camera.name, camera.name))


def findings(*points: Points, rows: Poses = ROWS) -> list[Finding]:
    cameras = [each.a.camera for each in points]
    views = [SimpleNamespace(timestamp_ns=time, cameras=cameras) for time in TIMES.tolist()]
    return list(camera_findings(points, rows, views, SECOND // 2))


FRONT, LEFT, RIGHT = (RIG[f"CAM_FRONT{side}"] for side in ("", "_LEFT", "_RIGHT"))
SOUND = [seen(camera) for camera in (LEFT, RIGHT)]


def test_points_that_move_as_the_vehicle_give_no_finding():
    assert not findings(seen(FRONT), *SOUND)


def test_a_body_that_pitches_gives_no_finding():
    pitch = Rotation.from_rotvec(np.radians([[0, each, 0] for each in (0.0, 0.5, -0.3, 0.4, 0.0, -0.5, 0.2)]))
    rows = replace(ROWS, rotations=ROWS.rotations @ pitch.as_matrix())
    points = [seen(camera, rows) for camera in (FRONT, LEFT, RIGHT)]
    assert share(misfits(points, ROWS)) < 0.7
    assert not findings(*points)


def test_exchanged_images_are_named_with_both_cameras():
    (finding,) = findings(stated(seen(LEFT), FRONT), stated(seen(FRONT), LEFT), seen(RIGHT))
    assert finding.code == "images-exchanged"
    assert {finding.camera, finding.message.split(",")[0].split()[-1]} == {"CAM_FRONT", "CAM_FRONT_LEFT"}


def test_opposite_cameras_are_told_apart_on_a_straight_way():
    way = np.column_stack([XS, 0 * XS, 0 * XS])
    rows = replace(ROWS, rotations=np.broadcast_to(np.eye(3), (7, 3, 3)), positions=way)
    turns = (rigid(rotation=rotation_about_z(yaw)) for yaw in (np.pi / 2, -np.pi / 2))
    sides = [replace(FRONT, ego_from_camera=turn @ FRONT.ego_from_camera) for turn in turns]
    left = seen(sides[0], rows)
    assert share(misfits([left], rows)) > 0.9 > 0.2 > share(misfits([stated(left, sides[1])], rows))


@pytest.mark.slow
def test_mirrored_images_are_named():
    points = Mistake("", "", "", {FRONT.name: FRONT}, mirrored=True).undone(seen(FRONT))
    (finding,) = findings(points, *SOUND)
    assert (finding.code, finding.camera) == ("images-mirrored", "CAM_FRONT")


@pytest.mark.slow
def test_images_of_the_frame_before_are_named_late():
    (finding,) = findings(seen(FRONT, shift=1), *SOUND)
    assert finding.code == "images-late"
    assert "500 ms too late" in finding.message


@pytest.mark.slow
def test_a_wrong_focal_length_is_named_with_its_factor():
    longer = replace(FRONT, intrinsics=FRONT.intrinsics * [[1.15, 1, 1], [1, 1.15, 1], [1, 1, 1]])
    (finding,) = findings(stated(seen(FRONT), longer), *SOUND)
    assert finding.code == "calibration-off"
    assert "1.15 times" in finding.message


def test_mirrored_poses_are_one_finding():
    flip = np.diag([1.0, -1, 1])
    rows = replace(ROWS, rotations=flip @ ROWS.rotations @ flip, positions=ROWS.positions @ flip)
    assert [each.code for each in findings(*SOUND, rows=rows)] == ["motion-axes"]


@pytest.mark.slow
def test_a_wrong_rotation_is_named_with_its_angle():
    turn = Rotation.from_rotvec(np.radians([2, 1.5, 0])).as_matrix()  # the stated camera looks up and right
    camera = replace(FRONT, ego_from_camera=FRONT.ego_from_camera @ rigid(rotation=turn))
    (finding,) = findings(stated(seen(FRONT), camera), *SOUND)
    assert finding.code == "calibration-off"
    assert "1.5° further left and 2.0° further down" in finding.message


def grey(count: int = 4) -> list[dict[str, np.ndarray]]:
    random = np.random.default_rng(1)
    return [{name: random.uniform(0, 255, (4, 6)) for name in "ABCD"} for _ in range(count)]


def test_dead_and_frozen_cameras_are_named():
    frames = [frame | {"B": np.full((4, 6), 3.0), "C": grey()[0]["C"]} for frame in grey()]
    found = [(each.code, each.camera) for each in image_findings("ABCD", frames)]
    assert found == [("camera-dead", "B"), ("camera-frozen", "C")]
    assert not image_findings("ABCD", [grey()[0]] * 4)  # of a vehicle that stands


def test_few_cameras_that_are_off_do_not_make_poses_wrong():
    poses, camera = (Finding(code, "error", None, code) for code in ("motion-wrong-drive", "calibration-off"))
    info = replace(poses, severity="info")
    assert one_cause((poses,), (camera,), 6) == (camera,)
    assert one_cause((poses,), (camera,) * 3, 6) == (poses,)
    assert one_cause((poses,), (), 6) == (poses,)
    assert one_cause((info,), (camera,), 6) == (info, camera)
    assert one_cause((info,), (camera,) * 4, 6) == (info,)
    assert one_cause((), (camera,), 1) == (camera,)
    assert one_cause((), (camera,) * 2, 2) == ()  # as a straight drive of KITTI seems


def boxes(xs: list[float], names: list[str], scores: list[float] | None = None) -> Boxes3D:
    count = len(xs)
    centers, sizes = np.column_stack([xs, np.zeros((count, 2))]), np.ones((count, 3))
    columns = {"yaws": np.zeros(count), "velocities": np.zeros((count, 2)), "classes": np.array(names)}
    return Boxes3D(centers, sizes, **columns, scores=None if scores is None else np.array(scores))


def test_boxes_agree_that_have_one_class_and_place():
    wanted = boxes([0, 10, 20, 30], ["car"] * 4, [0.9, 0.9, 0.9, 0.1])  # the last one is not counted
    given = boxes([1, 10, 23], ["car", "bus", "car"], [0.9, 0.9, 0.9])  # another class, and 3 m away
    assert repeated([wanted], [given]) == (3, 1 / 3)


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> planted_faults.Drive:
    cache, config = tmp_path_factory.mktemp("streets"), load_model("demo").config
    return RenderedDrives([1_000_000], cache, config).open(0)


@pytest.mark.slow
@pytest.mark.parametrize("fault", planted_faults.FAULTS)
def test_a_planted_fault_is_named_on_a_rendered_drive(street: planted_faults.Drive, fault: str):
    plant, code = planted_faults.FAULTS[fault]
    found = planted_faults.found_in(load_model("demo"), plant(street, "CAM_FRONT"), code)
    assert code in {finding.code for finding in found}


@pytest.mark.slow
@pytest.mark.parametrize("fault", planted_faults.MODEL_FAULTS)
def test_a_planted_fault_of_a_model_is_named(street: planted_faults.Drive, fault: str):
    change, code = planted_faults.MODEL_FAULTS[fault]
    assert [finding.code for finding in model_faults(change(load_model("demo")), street)] == [code]


@pytest.mark.slow
def test_a_sound_rendered_drive_has_no_fault(street: planted_faults.Drive):
    assert not [each for each in find_faults(load_model("demo"), street) if each.severity != "info"]
