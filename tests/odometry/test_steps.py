"""The motion of a vehicle through a drawn street: a road and two walls with a random texture, seen by two cameras."""

from functools import cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bevcli.frame import CameraImage, Frame, FrameStamp
from bevcli.geometry.cameras import Camera, CameraRig, default_ego_from_bev
from bevcli.geometry.ego_motion import Kinematics
from bevcli.geometry.transforms import Array, Pose, inverse, rigid, rotation_about_z
from bevcli.workshop.odometry.flow import road_flow
from bevcli.workshop.odometry.measure import MeasuredStep, MotionMeter
from bevcli.workshop.odometry.step_views import motion_of, next_slopes
from bevcli.workshop.odometry.views import CELL_M, SHAPE, RoadPicture
from bevcli.workshop.odometry.votes import distance_votes

TEXEL_M = 0.06
WALLS_M = 7.0  # to both sides
HALF_SECOND = 500_000_000
LOOKING_AHEAD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
INTRINSICS = np.array([[220.0, 0, 200], [0, 220, 125], [0, 0, 1]])
FRONT = Camera("FRONT", 400, 250, INTRINSICS, rigid((1.5, 0, 1.5), LOOKING_AHEAD))
BACK = Camera("BACK", 400, 250, INTRINSICS, rigid((0, 0.1, 1.6), rotation_about_z(np.pi) @ LOOKING_AHEAD))
RIG = CameraRig((FRONT, BACK), default_ego_from_bev())


@cache
def noise() -> NDArray[np.uint8]:
    """(1024, 1024) random grey values that repeat."""
    values = np.random.default_rng(7).normal(size=(1024, 1024))
    smooth = cv2.GaussianBlur(np.tile(values, (2, 2)), (0, 0), 1.5)[512:1536, 512:1536]
    return np.clip(128 + 90 * smooth / smooth.std() / 2, 0, 255).astype(np.uint8)


def drawn(camera: Camera, world_from_ego: Array) -> NDArray[np.uint8]:
    """(250, 400, 3) the street."""
    pixels = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1)
    pose = world_from_ego @ camera.ego_from_camera
    start, rays = pose[:3, 3], camera.rays(pixels.reshape(-1, 2)) @ pose[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        depths = np.stack([-start[2] / rays[:, 2], *((side - start[1]) / rays[:, 1] for side in (-WALLS_M, WALLS_M))])
    depths[~(depths > 0)] = np.inf
    nearest, depth = depths.argmin(0), np.minimum(depths.min(0), 1e3)
    x, y, z = (start + depth[:, None] * rays).T
    across = np.where(nearest == 0, y, z + 17.0 * nearest)
    at = np.stack([x, across]) / TEXEL_M % 1023
    grey = cv2.remap(noise(), *(side.reshape(pixels.shape[:2]).astype(np.float32) for side in at), cv2.INTER_LINEAR)
    return np.repeat(grey[..., None], 3, axis=-1)


def frame(index: int, world_from_ego: Array) -> Frame:
    """The frame at a pose; it does not state it."""
    time = index * HALF_SECOND
    images = {camera.name: CameraImage(time, drawn(camera, world_from_ego)) for camera in RIG.cameras}
    rest = Kinematics(np.array([0, 0, 9.81]), np.zeros(3), np.zeros(3))
    return Frame(FrameStamp(index, "", time), RIG, images, Pose.identity(), {}, rest)


def measured(step: Array, frames: int = 3) -> list[MeasuredStep]:
    """The steps of a vehicle that moves by the same step between frames."""
    meter, pose, steps = MotionMeter(), np.eye(4), list[MeasuredStep]()
    for index in range(frames):
        steps += meter.add(frame(index, pose))
        pose = pose @ step
    return steps + meter.finish()


@pytest.mark.parametrize(
    "step",
    [rigid((1.1, 0.03, 0), rotation_about_z(0.05)), rigid((-0.9, 0.02, 0), rotation_about_z(-0.04))],
    ids=["forwards in a curve", "backwards"],
)
def test_a_motion_is_found_in_metres(step: Array) -> None:
    steps = measured(step)
    assert len(steps) == 2
    for each in steps:
        assert each.reason == ""
        error = inverse(step) @ each.ego_a_from_ego_b
        assert np.linalg.norm(error[:3, 3]) < 0.02
        assert np.degrees(Rotation.from_matrix(error[:3, :3]).magnitude()) < 0.1
        assert np.abs(each.ego_a_from_ego_b[:3, 3] - step[:3, 3]).max() < 4 * each.deviations[3:].max()


def test_standing_is_measured_and_not_guessed() -> None:
    (step,) = measured(np.eye(4), frames=2)
    assert step.reason == ""
    np.testing.assert_allclose(step.ego_a_from_ego_b, np.eye(4), atol=1e-3)
    assert step.deviations[3:].max() < 0.01


def picture(shift: tuple[int, int]) -> RoadPicture:
    """The road seen from above by one camera, shifted by cells along y and x."""
    cells = np.roll(noise()[: SHAPE[0] + 60, : SHAPE[1] + 200], shift, axis=(0, 1))[30:, 100:]
    seen = np.ones(SHAPE, dtype=bool)
    return RoadPicture(cells[: SHAPE[0], : SHAPE[1]], seen, np.zeros(SHAPE, dtype=np.int8), np.zeros(2))


def test_tiles_vote_for_the_distance_driven() -> None:
    first, second = picture((0, 0)), picture((0, -35))  # what was 35 cells ahead is near now
    distances, votes = distance_votes(first, second, 0.0, 0.0, (-10, 60))
    assert distances[votes.argmax()] == pytest.approx(35 * CELL_M)
    assert votes[np.abs(distances - 35 * CELL_M) > 4 * CELL_M].max() < 0.2 * votes.max()


def test_the_flow_tells_what_a_motion_misses() -> None:
    flow = road_flow(picture((0, 0)), picture((1, -12)), 0.0, np.array([11.0, 0]) * CELL_M, 0.5)
    assert len(flow.first) > 100
    np.testing.assert_allclose(
        np.median(flow.first - flow.second, axis=0), [12 * CELL_M, -CELL_M, 0], atol=0.1 * CELL_M
    )


def test_a_vehicle_that_drives_along_a_slope_stays_on_it() -> None:
    state = np.array([0, 0.02, 0.1, 4.0, 0.3, 0, 0.03, -0.01])
    motion, slopes = motion_of(state), next_slopes(state)
    for ahead in ((0.0, 0.0), (5.0, 1.0)):  # points of the road in the second ego frame lie on it in the first one
        x, y, z, _ = motion @ [*ahead, slopes @ ahead, 1]
        assert z == pytest.approx(0.03 * x - 0.01 * y)
