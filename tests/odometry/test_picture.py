"""The road from above, stitched along the way; the picture and the recording that show it."""

from dataclasses import replace

import numpy as np
import pytest
from memory_drive import MemoryDrive, make_camera
from rerun.chunk import RrdReader
from true_motion import motion_of

from bevcli.geometry.cameras import CameraRig, default_ego_from_bev
from bevcli.geometry.transforms import apply
from bevcli.workshop.odometry.picture import GroundView, WatchedDrive, ground_cells, stitched, write_picture
from bevcli.workshop.odometry.recording import write_recording
from bevcli.workshop.odometry.steps import SeenPoints, seen_points

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


def test_pixels_of_poses_are_where_the_road_was_stitched(watched):
    drive, motion = watched
    road = stitched(drive, motion.poses)
    first, last = road.pixels(motion.poses)[[0, -1]]
    assert first == pytest.approx((150, road.image.shape[0] - 150), abs=1.5)
    assert (last - first)[0] == pytest.approx(90, abs=1)  # 9 m ahead


def test_the_picture_and_the_recording_are_written(watched, tmp_path):
    drive, motion = watched
    points = SeenPoints(
        np.zeros(1, np.int16), np.full((1, 2), 0.5, np.float32), np.ones(1, np.float32), np.ones(1, bool)
    )
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
    seen = seen_points(
        cameras, (of, cameras[0].rays(pixels), residuals), (of[:4], cameras[0].rays(pixels[:4]), residuals[:4])
    )
    assert np.bincount(seen.camera[~seen.is_road]).tolist() == [50, 50]  # every fourth of 200
    assert seen.is_road.sum() == 4
    assert seen.at[0] * (640, 360) == pytest.approx(pixels[0], abs=0.01)
    assert seen.residuals_px == pytest.approx(np.hypot(3, 3))


def test_a_drive_without_poses_has_no_stated_ones():
    drive = MemoryDrive(1)
    drive.has_ego_motion = False
    watched = WatchedDrive(drive)
    watched.load(0)
    assert watched.stated_poses is None
