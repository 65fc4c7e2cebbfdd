"""The report of a measured motion and its picture: numbers, files that are read back, a stitched road."""

import json
from dataclasses import replace

import numpy as np
import pytest
from memory_drive import MemoryDrive, make_camera
from rerun.chunk import RrdReader
from scipy.spatial.transform import Rotation
from true_motion import STREET, motion_of, street_copy

import bevcli
from bevcli.errors import Finding, InputError
from bevcli.geometry.cameras import CameraRig, default_ego_from_bev
from bevcli.geometry.transforms import apply, rigid, rotation_about_z
from bevcli.sequences.files.ego_motion_file import read_ego_motion
from bevcli.workshop.odometry.measure import MeasuredMotion, MeasuredStep
from bevcli.workshop.odometry.picture import (
    GroundView,
    WatchedDrive,
    ground_cells,
    stitched,
    write_picture,
    write_recording,
)
from bevcli.workshop.odometry.report import (
    against_stated,
    check_measured,
    end_deviations,
    measured_note,
    report_text,
    speeds,
    to_json,
    write_report,
    yaw_rates_deg,
)
from bevcli.workshop.odometry.steps import SeenPoints, seen_points

DEVIATIONS = np.array([0.002, 0.001, 0.01, 0.03, 0.02, 0.01])


def curve(steps: int = 6, reason: str = "", step_s: float = 0.5) -> MeasuredMotion:
    """A vehicle that turns to the left: 2 m and 0.2 radians a step."""
    step = MeasuredStep(rigid((2, 0.1, 0), rotation_about_z(0.2)), np.diag(DEVIATIONS**2), reason)
    times = 10**9 + np.arange(steps + 1, dtype=np.int64) * int(step_s * 1e9)
    return MeasuredMotion("curve", times, (step,) * steps)


@pytest.fixture(scope="module")
def street():
    return bevcli.open_sequence(STREET, ground_truth=False, frames=slice(0, 6))


def test_the_deviation_of_the_end_is_that_of_many_drives():
    motion, random = curve(), np.random.default_rng(0)
    poses = np.tile(np.eye(4), (4000, 1, 1))
    shared = random.normal(scale=DEVIATIONS, size=(len(poses), 6))  # by the calibration
    for step in motion.steps:
        errors = (shared + random.normal(scale=DEVIATIONS, size=(len(poses), 6))) / np.sqrt(2)
        steps = np.tile(step.ego_a_from_ego_b, (len(poses), 1, 1))
        steps[:, :3, :3] = Rotation.from_rotvec(errors[:, :3]).as_matrix() @ steps[:, :3, :3]
        steps[:, :3, 3] += errors[:, 3:]
        poses = poses @ steps
    end = motion.poses[-1]
    apart = ((poses[:, :3, 3] - end[:3, 3]) ** 2).sum(-1)
    turned = Rotation.from_matrix(end[:3, :3].T @ poses[:, :3, :3]).magnitude()
    end_m, end_deg = end_deviations(motion)
    assert end_m == pytest.approx(np.sqrt(apart.mean()), rel=0.05)
    assert end_deg == pytest.approx(np.degrees(np.sqrt((turned**2).mean())), rel=0.05)


def test_speed_and_yaw_rate_are_those_of_the_step():
    speed, speed_deviation = speeds(curve())
    assert speed == pytest.approx(2 * np.hypot(2, 0.1))
    assert speed_deviation == pytest.approx(2 * 0.03, rel=0.01)
    rate, rate_deviation = yaw_rates_deg(curve())
    assert rate == pytest.approx(np.degrees(0.4))
    assert rate_deviation == pytest.approx(np.degrees(0.02))
    back = MeasuredMotion("back", curve(1).timestamps_ns, (MeasuredStep(rigid((-1, 0, 0)), np.eye(6)),))
    assert speeds(back)[0] == pytest.approx(-2)


def test_the_files_give_the_motion_back(street, tmp_path):
    """Also at the times of the images, which are not those of the frames."""
    motion = motion_of(street)
    write_report(motion, tmp_path / "out")
    read = read_ego_motion(tmp_path / "out/ego_motion.csv")
    for pose, time in zip(motion.poses, motion.timestamps_ns, strict=True):
        assert read.pose_at(int(time)).matrix == pytest.approx(pose, abs=1e-9)
    report = json.loads((tmp_path / "out/report.json").read_text())
    assert len(report["steps"]) == len(motion.steps)
    assert report["steps"][2]["translation_deviation_m"] == pytest.approx([0.01] * 3)
    assert report["stated"] is None
    copy, poses = street_copy(tmp_path / "copy", 6), tmp_path / "out/ego_motion.csv"
    again = bevcli.open_sequence(copy, ego_motion_file=poses, ground_truth=False)
    first = np.linalg.inv(street.load(0).world_from_ego.matrix)
    for place in range(len(street.stamps)):
        stated, written = street.load(place), again.load(place)
        assert written.world_from_ego.matrix == pytest.approx(first @ stated.world_from_ego.matrix, abs=1e-6)
        for name, pose in stated.world_from_ego_at.items():
            assert written.world_from_ego_at[name].matrix == pytest.approx(first @ pose.matrix, abs=0.02)


def test_a_scale_is_seen_against_stated_poses(street):
    poses = [street.load(place).world_from_ego.matrix for place in range(len(street.stamps))]
    difference = against_stated(motion_of(street, scale=1.02), poses)
    straight = np.linalg.norm(poses[-1][:3, 3] - poses[0][:3, 3])
    assert difference.end_m == pytest.approx(0.02 * straight, rel=0.01)
    assert difference.end_deg == pytest.approx(0, abs=1e-5)
    assert "(2.0 %)" in difference.text()
    wrong = Finding("speed", "error", None, "the wheel is small", advice="measure it")
    assert "error: the wheel is small: measure it" in report_text(motion_of(street), difference, [wrong])


def test_steps_that_are_guesses_are_counted_with_their_reasons(street):
    motion = motion_of(street, guessed=(1, 3))
    assert "not measured  2 steps (too dark)" in report_text(motion)
    assert measured_note(motion).endswith("in 5 steps; not measured: 2 steps (too dark)")
    assert json.loads(to_json(motion))["not_measured"] == {"too dark": 2}


def test_a_drive_without_a_measured_step_is_refused():
    check_measured(curve())
    with pytest.raises(InputError, match=r"curve: not one of 6 steps could be measured \(too dark\)"):
        check_measured(curve(reason="too dark"))
    still = MeasuredMotion("still", np.array([5], dtype=np.int64), ())  # one frame has no steps
    assert "0.00 m in 0.0 s, 0 steps" in report_text(still)
    assert json.loads(to_json(still))["mean_speed_m_s"] is None


SQUARE_M = 3.0


def squares(places):
    """(...,) 0 or 1 for places (..., 2) of the world: a chess board."""
    return (np.floor(places / SQUARE_M).sum(-1) % 2).astype(np.uint8)


class ChessBoard(MemoryDrive):
    """A drive over a chess board, whose images are made ray by ray."""

    def load(self, place):
        frame = super().load(place)
        images = {}
        for camera in self.rig.cameras:
            pixels = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1)
            rays = camera.rays(pixels) @ camera.ego_from_camera[:3, :3].T
            origin = camera.ego_from_camera[:3, 3]
            with np.errstate(divide="ignore"):
                far = np.where(rays[..., 2] < 0, -origin[2] / rays[..., 2], 0)
            ground = apply(frame.world_from_ego.matrix, origin + far[..., None] * rays)
            shade = np.where(far > 0, 60 + 160 * squares(ground[..., :2]), 10).astype(np.uint8)
            images[camera.name] = replace(frame.images[camera.name], pixels_bgr=np.repeat(shade[..., None], 3, -1))
        return replace(frame, images=images)


@pytest.fixture(scope="module")
def watched():
    """Frames of two cameras, and their true motion."""
    cameras = tuple(make_camera(name, yaw, 480, 270) for name, yaw in (("front", 0), ("back", 180)))
    drive = WatchedDrive(ChessBoard(4, CameraRig(cameras, default_ego_from_bev())))
    return drive, motion_of(drive)


def test_cells_lie_ahead_and_to_the_left_first():
    cells = ground_cells()
    assert cells[0, 0] == pytest.approx((14.95, 14.95, 0))
    assert cells[-1, 0] == pytest.approx((-14.95, 14.95, 0))
    assert cells[0, -1] == pytest.approx((14.95, -14.95, 0))
    drive = MemoryDrive(1)
    drive.has_ego_motion = False
    watched = WatchedDrive(drive)
    watched.load(0)
    assert watched.stated_poses is None


def test_a_frame_shows_the_board_from_above(watched):
    drive, _ = watched
    frame = drive.load(2)
    view = GroundView(frame.rig)
    expected = squares(apply(frame.world_from_ego.matrix, ground_cells())[..., :2])
    seen = view.weight > 0
    assert seen.mean() > 0.1
    assert ((view.of(frame)[..., 0] > 140) == expected)[seen].mean() > 0.95


def test_the_stitched_road_is_the_board(watched):
    drive, motion = watched
    road = stitched(drive, motion.poses)
    height, width = road.image.shape[:2]
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    x = road.x_range_m[0] + (columns + 0.5) * (road.x_range_m[1] - road.x_range_m[0]) / width
    y = road.y_range_m[1] - (rows + 0.5) * (road.y_range_m[1] - road.y_range_m[0]) / height
    seen = road.image[..., 0] < 240
    assert seen.mean() > 0.2
    assert ((road.image[..., 0] > 140) == squares(np.stack([x, y], axis=-1)))[seen].mean() > 0.95
    first, last = road.pixels(motion.poses)[[0, -1]]
    assert first == pytest.approx((150, road.image.shape[0] - 150), abs=1.5)
    assert (last - first)[0] == pytest.approx(90, abs=1)  # 9 m ahead


def test_the_picture_and_the_recording_are_written(watched, tmp_path):
    drive, motion = watched
    where = np.full((1, 2), 0.5, np.float32)
    points = SeenPoints(np.zeros(1, np.int16), where, np.ones(1, np.float32), np.ones(1, bool))
    seen, unseen = replace(motion.steps[0], seen=points), replace(motion.steps[2], reason="too dark")
    guessed = replace(motion, steps=(seen, motion.steps[1], unseen))
    road = stitched(drive, motion.poses)
    write_picture(tmp_path / "odometry.png", guessed, road, drive.stated_poses)
    assert (tmp_path / "odometry.png").read_bytes().startswith(b"\x89PNG")
    write_recording(tmp_path / "odometry.rrd", guessed, drive, road, drive.stated_poses)
    assert (tmp_path / "odometry.rrd").stat().st_size < 500_000
    entities = [chunk.entity_path for chunk in RrdReader(tmp_path / "odometry.rrd").stream()]
    shown = {"/way/road", "/way/measured", "/road/image", "/curves/speed/measured", "/events", "/cameras/front/points"}
    assert shown <= set(entities)


def test_an_even_choice_of_the_points_is_shown_where_they_are():
    cameras = [make_camera("front", 0, 640, 360), make_camera("back", 180, 640, 360)]
    pixels = np.stack([np.linspace(10, 630, 400), np.linspace(20, 340, 400)], axis=-1)
    of, residuals = np.arange(400) % 2, np.full((400, 2), 3.0)
    rays = cameras[0].rays(pixels)
    seen = seen_points(cameras, (of, rays, residuals), (of[:4], rays[:4], residuals[:4]))
    assert np.bincount(seen.camera[~seen.is_road]).tolist() == [50, 50]  # every fourth of 200
    assert seen.is_road.sum() == 4
    assert seen.at[0] * (640, 360) == pytest.approx(pixels[0], abs=0.01)
    assert seen.residuals_px == pytest.approx(np.hypot(3, 3))
