"""The motion of a vehicle through a drawn street with a random texture, seen by two cameras; votes on it."""

from dataclasses import replace
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
from bevcli.workshop.correspondence.residuals import EpipolarResiduals, GroupGeometry
from bevcli.workshop.odometry.measure import Chain, MeasuredStep, MotionMeter, leaps
from bevcli.workshop.odometry.step_views import CELL_M, SHAPE, RoadPicture, motion_of, next_slopes, road_flow
from bevcli.workshop.odometry.steps import (
    CHANCE,
    Candidate,
    distance_votes,
    point_votes,
    stands,
    under_the_road,
    ways_of_points,
)

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
    [
        rigid((1.1, 0.03, 0), rotation_about_z(0.05)),
        pytest.param(rigid((-0.9, 0.02, 0), rotation_about_z(-0.04)), marks=pytest.mark.slow),
    ],
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
    missed = np.median(flow.first - flow.second, axis=0)
    np.testing.assert_allclose(missed, [12 * CELL_M, -CELL_M, 0], atol=0.1 * CELL_M)


def test_a_vehicle_that_drives_along_a_slope_stays_on_it() -> None:
    state = np.array([0, 0.02, 0.1, 4.0, 0.3, 0, 0.03, -0.01])
    motion, slopes = motion_of(state), next_slopes(state)
    for ahead in ((0.0, 0.0), (5.0, 1.0)):  # points of the road in the second ego frame lie on it in the first one
        x, y, z, _ = motion @ [*ahead, slopes @ ahead, 1]
        assert z == pytest.approx(0.03 * x - 0.01 * y)


def driven(distance: float, votes: float, yaw: float = 0.0) -> Candidate:
    """A motion along x."""
    return Candidate(np.array([0, 0, yaw, distance, 0, 0, 0, 0]), np.eye(6), votes, 0, 0)


def chosen(steps: list[list[Candidate]], seconds: float = 0.5) -> list[float]:
    """The distances that the chain decides."""
    chain = Chain()
    decided = [chain.add(step, seconds) for step in steps] + [chain.end()]
    return [float(each.state[3]) for each in decided if each is not None]


def test_the_neighbours_decide_where_votes_are_about_equal() -> None:
    right, wrong = driven(4.0, 4.0), driven(1.0, 4.1)
    assert chosen([[driven(4.1, 5.0)], [wrong, right], [driven(3.9, 5.0)]]) == [4.1, 4.0, 3.9]
    assert chosen([[wrong, right], [driven(4.0, 5.0)]]) == [4.0, 4.0]  # the next step decides about the first
    assert chosen([[driven(4.0, 5.0)], [wrong, right]]) == [4.0, 4.0]
    # Many votes outweigh a change of speed; backwards is not the same speed.
    assert chosen([[driven(4.0, 5.0)], [driven(3.0, 9.0), driven(4.0, 2.0)]]) == [4.0, 3.0]
    assert chosen([[driven(-2.0, 5.0)], [driven(2.0, 4.1), driven(-2.0, 4.0)]]) == [-2.0, -2.0]


def test_a_leap_with_few_points_of_the_road_is_not_believed() -> None:
    before, short, after = driven(4.0, 1.0), driven(0.9, 1.0), driven(4.2, 1.0)
    times = 0.5, 0.5, 0.5
    assert leaps(before, short, after, times)
    assert not leaps(before, replace(short, road_points=400), after, times)
    assert not leaps(before, short, driven(0.2, 1.0), times)  # it brakes
    assert not leaps(before, driven(3.5, 1.0), after, times)


def test_a_step_is_decided_one_step_later() -> None:
    chain = Chain()
    first, second = driven(1.0, 1.0), driven(1.1, 1.0)
    assert chain.add([first], 0.5) is None
    assert chain.likeliest is first
    assert chain.add([second], 0.5) is first
    assert chain.end() is second
    assert chain.end() is None


HEIGHT_M, FOCAL = 1.5, 1000.0
FORWARD = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, HEIGHT_M], [0, 0, 0, 1]])  # ego_from_camera
DISTANCES = np.arange(-1.0, 8.0, 0.08)


def matches(points: Array, moved: Array) -> EpipolarResiduals:
    """Points (n, 3) of the ego frame that the second image shows nearer by `moved` (n,), along x."""
    later = points - np.column_stack([moved, np.zeros((len(points), 2))])
    rays = [(each - FORWARD[:3, 3]) @ FORWARD[:3, :3] for each in (points, later)]
    a, b = (each / np.linalg.norm(each, axis=-1, keepdims=True) for each in rays)
    return EpipolarResiduals(np.zeros(len(points), dtype=np.int64), a, b, np.full(len(points), FOCAL))


def ways(points: Array, moved: Array, assumed_m: float = 4.0) -> Array:
    """The ways of `matches`."""
    geometry = GroupGeometry(FORWARD[None], FORWARD[None], rigid((-assumed_m, 0, 0))[None], np.zeros(2))
    return ways_of_points(matches(points, moved), geometry, assumed_m)


def street(count: int, highest_m: float) -> Array:
    """Points of the road, or of what stands on it."""
    random = np.random.default_rng(count)
    return random.uniform((8, -6, 0), (25, 6, highest_m), (count, 3))


def most_voted(found: Array) -> float:
    """The distance with the most votes."""
    return float(DISTANCES[int(np.argmax(point_votes(found, DISTANCES) * (DISTANCES > 0)))])


@pytest.mark.parametrize("moved_m", [0.4, 3.0])
def test_points_of_the_road_tell_the_way(moved_m: float) -> None:
    found = ways(street(40, 0.0), np.full(40, moved_m))
    np.testing.assert_allclose(found[np.isfinite(found)], moved_m, rtol=1e-6)
    assert most_voted(found) == pytest.approx(moved_m, abs=0.05)


def test_higher_points_and_vehicles_do_not_outvote_the_road() -> None:
    points = np.concatenate([street(30, 0.0), street(30, 1.2), street(20, 1.0)])
    moved = np.concatenate([np.full(60, 3.0), np.full(20, 0.3)])  # the last ones drive ahead, a little slower
    assert most_voted(ways(points, moved)) == pytest.approx(3.0, rel=0.05)


def test_vehicles_ahead_would_lie_under_the_road() -> None:
    points = np.concatenate([street(30, 0.0), street(30, 1.2), street(20, 1.0)])
    found = under_the_road(ways(points, np.concatenate([np.full(60, 3.0), np.full(20, 0.5)])))
    assert not found[:60].any()
    assert found[60:].mean() > 0.8


def test_points_that_stay_tell_nothing() -> None:
    points = np.concatenate([street(30, 0.0), street(60, 0.0)])
    found = ways(points, np.concatenate([np.full(30, 3.0), np.zeros(60)]))  # such as drops on the lens
    assert np.isfinite(found).sum() == 30
    assert most_voted(found) == pytest.approx(3.0, abs=0.05)
    assert point_votes(found, np.zeros(1)) == pytest.approx(CHANCE)  # "stands" gets the least votes
    np.testing.assert_array_equal(point_votes(np.full(5, 3.0), DISTANCES), 1.0)  # few points do not vote


def stays(points: Array, moved_m: Array) -> bool:
    """The answer of `stands` for `matches`."""
    return stands(matches(points, moved_m), np.broadcast_to(FORWARD, (len(points), 4, 4)))


def before_houses(far: int, road: int) -> Array:
    """Houses far away, and points of the road near the vehicle."""
    random = np.random.default_rng(1)
    houses = random.uniform((60, -40, 2), (150, 40, 12), (far, 3))
    return np.concatenate([houses, random.uniform((5, -4, 0), (12, 4, 0), (road, 3))])


def test_a_vehicle_stands_although_one_car_moves() -> None:
    points = before_houses(80, 20)
    moved = np.where(np.arange(100) >= 92, 2.0, 0.0)  # 8 of the 20 near points
    assert stays(points, moved)
    assert not stays(points, np.full(100, 2.0))


def test_a_creeping_vehicle_does_not_stand() -> None:
    assert not stays(before_houses(180, 20), np.full(200, 0.07))  # 90 % of the points stay, but not those of the road
    assert stays(before_houses(180, 20), np.full(200, 0.001))
    assert not stays(before_houses(20, 0), np.zeros(20))  # few points do not tell
