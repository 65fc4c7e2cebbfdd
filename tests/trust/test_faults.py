"""Faults that show without labels: on points and images made by hand, and on a rendered drive."""

from dataclasses import replace

import numpy as np
import planted_faults
import pytest
from memory_drive import MemoryDrive
from scipy.spatial.transform import Rotation

from bevcli.errors import Finding
from bevcli.frame import CameraImage
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import Camera, CameraRig
from bevcli.geometry.transforms import inverse, rigid, rotation_about_z
from bevcli.inference.load import load_model
from bevcli.workshop.correspondence.poses import Poses
from bevcli.workshop.synth.drives import RenderedDrives
from bevcli.workshop.synth.rig import nuscenes_like_rig
from bevcli.workshop.trust.camera_faults import CameraPoints, camera_findings, share
from bevcli.workshop.trust.faults import (
    ReversedColors,
    find_faults,
    image_findings,
    input_faults,
    model_faults,
    one_cause,
    repeated,
)

RIG: CameraRig = nuscenes_like_rig(512, 288)
SECOND = 1_000_000_000
# A vehicle that turns and accelerates: seven poses, two a second.
TIMES = np.arange(7) * SECOND // 2
YAWS = np.array([0, 0.05, 0.14, 0.3, 0.4, 0.45, 0.47])
XS, YS = np.array([0, 2, 4.5, 7.5, 11, 14, 16.0]), np.array([0, 0, 0.4, 1.3, 2.8, 4.2, 5.2])
ROWS = Poses(TIMES, np.stack(list(map(rotation_about_z, YAWS))), np.column_stack([XS, YS, 0 * XS]))


def seen(camera: Camera, shift: int = 0, rows: Poses = ROWS) -> CameraPoints:
    """Points of a camera in five steps; with a shift, those that it showed some steps before."""
    random, rays, times = np.random.default_rng(0), ([], []), []
    poses, _ = rows.at(TIMES)
    for step in range(1, 6):
        places = random.uniform((0, 0), (camera.width, camera.height), (60, 2))
        ahead = camera.rays(places) * random.uniform(4, 40, (60, 1))
        first, second = (pose @ camera.ego_from_camera for pose in poses[step - shift : step + 2 - shift])
        motion = inverse(second) @ first
        then = ahead @ motion[:3, :3].T + motion[:3, 3]
        for side, points in zip(rays, (ahead, then), strict=True):
            side.append(points / np.linalg.norm(points, axis=1, keepdims=True))
        times.append(np.broadcast_to(TIMES[step : step + 2], (60, 2)))
    return CameraPoints(camera, np.concatenate(rays[0]), np.concatenate(rays[1]), np.concatenate(times))


def found(points: dict[str, CameraPoints]) -> list[tuple[str, str | None]]:
    return [(finding.code, finding.camera) for finding in camera_findings(points, ROWS, RIG)]


FRONT, LEFT = RIG["CAM_FRONT"], RIG["CAM_FRONT_LEFT"]
SOUND = {camera.name: seen(camera) for camera in (FRONT, LEFT)}


def test_points_that_move_as_the_vehicle_give_no_finding():
    assert not found(SOUND)


def test_exchanged_images_are_named_with_both_cameras():
    points = SOUND | {"CAM_FRONT": seen(LEFT).seen_by(FRONT), "CAM_FRONT_LEFT": seen(FRONT).seen_by(LEFT)}
    (finding,) = camera_findings(points, ROWS, RIG)
    assert finding.code == "images-exchanged"
    assert "CAM_FRONT:" in finding.line
    assert "CAM_FRONT_LEFT" in finding.message


def test_opposite_cameras_are_told_apart_on_a_straight_way():
    way = np.column_stack([XS, 0 * XS, 0 * XS])
    rows = replace(ROWS, rotations=np.broadcast_to(np.eye(3), (7, 3, 3)), positions=way)
    turns = (rigid(rotation=rotation_about_z(yaw)) for yaw in (np.pi / 2, -np.pi / 2))
    sides = [replace(FRONT, ego_from_camera=turn @ FRONT.ego_from_camera) for turn in turns]
    left = seen(sides[0], rows=rows)
    assert share(left, rows) > 0.9 > 0.2 > share(left.seen_by(sides[1]), rows)


def test_mirrored_images_are_named():
    points = SOUND["CAM_FRONT"].mirrored()
    assert found(SOUND | {"CAM_FRONT": points}) == [("images-mirrored", "CAM_FRONT")]
    assert np.allclose(points.mirrored().rays_a, SOUND["CAM_FRONT"].rays_a)


def test_images_of_the_frame_before_are_named_late():
    (finding,) = camera_findings(SOUND | {"CAM_FRONT": seen(FRONT, shift=1)}, ROWS, RIG)
    assert finding.code == "images-late"
    assert "500 ms too late" in finding.message


def test_a_wrong_focal_length_is_named_with_its_factor():
    stated = replace(FRONT, intrinsics=FRONT.intrinsics * [[1.15, 1, 1], [1, 1.15, 1], [1, 1, 1]])
    (finding,) = camera_findings(SOUND | {"CAM_FRONT": SOUND["CAM_FRONT"].seen_by(stated)}, ROWS, RIG)
    assert finding.code == "focal-length"
    assert "1.15 times" in finding.message


def test_mirrored_poses_are_one_finding():
    flip = np.diag([1.0, -1, 1])
    rows = replace(ROWS, rotations=flip @ ROWS.rotations @ flip, positions=ROWS.positions @ flip)
    assert [each.code for each in camera_findings(SOUND, rows, RIG)] == ["motion-axes"]


@pytest.mark.parametrize(("axis", "words"), [(1, "2.0° further left"), (0, "2.0° further down")])
def test_a_wrong_rotation_is_named_with_its_angle(axis: int, words: str):
    turn = Rotation.from_rotvec(np.radians(2) * np.eye(3)[axis]).as_matrix()  # the stated camera looks right, or up
    stated = replace(FRONT, ego_from_camera=FRONT.ego_from_camera @ rigid(rotation=turn))
    (finding,) = camera_findings(SOUND | {"CAM_FRONT": replace(SOUND["CAM_FRONT"], camera=stated)}, ROWS, RIG)
    assert finding.code == "rotation-off"
    assert words in finding.message


def grey(count: int = 4) -> list[dict[str, np.ndarray]]:
    random = np.random.default_rng(1)
    return [{name: random.uniform(0, 255, (4, 6)) for name in "ABCD"} for _ in range(count)]


def test_dead_and_frozen_cameras_are_named():
    frames = [frame | {"B": np.full((4, 6), 3.0), "C": grey()[0]["C"]} for frame in grey()]
    found = [(each.code, each.camera) for each in image_findings("ABCD", frames)]
    assert found == [("camera-dead", "B"), ("camera-frozen", "C")]
    assert not image_findings("ABCD", [grey()[0]] * 4)  # of a vehicle that stands


def test_few_cameras_that_are_off_do_not_make_poses_wrong():
    poses, camera = (Finding(code, "error", None, code) for code in ("motion-wrong-drive", "rotation-off"))
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


def test_colors_that_are_reversed_twice_are_the_same():
    pixels = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
    drive = MemoryDrive(1)
    drive.load = lambda index: replace(MemoryDrive(1).load(index), images={"CAM_FRONT": CameraImage(0, pixels)})
    once = ReversedColors(drive)
    assert once.load(0).images["CAM_FRONT"].pixels_bgr[0, 0].tolist() == [2, 1, 0]
    assert np.array_equal(ReversedColors(once).load(0).images["CAM_FRONT"].pixels_bgr, pixels)


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> planted_faults.Drive:
    cache, config = tmp_path_factory.mktemp("streets"), load_model("demo").config
    return RenderedDrives([1_000_000], cache, config).open(0)


@pytest.mark.slow
@pytest.mark.parametrize("fault", planted_faults.FAULTS)
def test_a_planted_fault_is_named_on_a_rendered_drive(street: planted_faults.Drive, fault: str):
    plant, code = planted_faults.FAULTS[fault]
    faulty = plant(street, "CAM_FRONT")
    findings = find_faults(load_model("demo"), faulty) if code == "color-order" else input_faults(faulty)
    assert code in {finding.code for finding in findings}


@pytest.mark.slow
@pytest.mark.parametrize("fault", planted_faults.MODEL_FAULTS)
def test_a_planted_fault_of_a_model_is_named(street: planted_faults.Drive, fault: str):
    change, code = planted_faults.MODEL_FAULTS[fault]
    assert [finding.code for finding in model_faults(change(load_model("demo")), street)] == [code]


@pytest.mark.slow
def test_a_sound_rendered_drive_has_no_fault(street: planted_faults.Drive):
    assert not [each for each in find_faults(load_model("demo"), street) if each.severity != "info"]
