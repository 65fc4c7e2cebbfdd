"""The way of a step by matched points that lie on the road, and whether the vehicle stands."""

import numpy as np
import pytest

from bevcli.geometry.transforms import Array, rigid
from bevcli.workshop.correspondence.residuals import EpipolarResiduals, GroupGeometry
from bevcli.workshop.odometry.votes import CHANCE, point_votes, stands, under_the_road, ways_of_points

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


def chosen(found: Array) -> float:
    """The distance with the most votes."""
    return float(DISTANCES[int(np.argmax(point_votes(found, DISTANCES) * (DISTANCES > 0)))])


@pytest.mark.parametrize("moved_m", [0.4, 3.0])
def test_points_of_the_road_tell_the_way(moved_m: float) -> None:
    found = ways(street(40, 0.0), np.full(40, moved_m))
    np.testing.assert_allclose(found[np.isfinite(found)], moved_m, rtol=1e-6)
    assert chosen(found) == pytest.approx(moved_m, abs=0.05)


def test_higher_points_and_vehicles_do_not_outvote_the_road() -> None:
    points = np.concatenate([street(30, 0.0), street(30, 1.2), street(20, 1.0)])
    moved = np.concatenate([np.full(60, 3.0), np.full(20, 0.3)])  # the last ones drive ahead, a little slower
    assert chosen(ways(points, moved)) == pytest.approx(3.0, rel=0.05)


def test_vehicles_ahead_would_lie_under_the_road() -> None:
    points = np.concatenate([street(30, 0.0), street(30, 1.2), street(20, 1.0)])
    found = under_the_road(ways(points, np.concatenate([np.full(60, 3.0), np.full(20, 0.5)])))
    assert not found[:60].any()
    assert found[60:].mean() > 0.8


def test_points_that_stay_tell_nothing() -> None:
    points = np.concatenate([street(30, 0.0), street(60, 0.0)])
    found = ways(points, np.concatenate([np.full(30, 3.0), np.zeros(60)]))  # such as drops on the lens
    assert np.isfinite(found).sum() == 30
    assert chosen(found) == pytest.approx(3.0, abs=0.05)
    assert point_votes(found, np.zeros(1)) == pytest.approx(CHANCE)  # "stands" gets the least votes


def test_few_points_do_not_vote() -> None:
    np.testing.assert_array_equal(point_votes(np.full(5, 3.0), DISTANCES), 1.0)


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


def test_few_points_do_not_tell_that_a_vehicle_stands() -> None:
    assert not stays(before_houses(20, 0), np.zeros(20))
