"""Matched points of a vehicle that stands, and of one that creeps."""

import numpy as np

from bevcli.geometry.transforms import Array
from bevcli.workshop.correspondence.residuals import EpipolarResiduals
from bevcli.workshop.odometry.unmoved import stands

FOCAL = 1000.0
FORWARD = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]])  # ego_from_camera


def seen(points: Array, moved_m: Array) -> bool:
    """The answer for points (n, 3) of the ego frame that come nearer by metres (n,)."""
    later = points - np.column_stack([moved_m, np.zeros((len(points), 2))])
    rays = [(each - FORWARD[:3, 3]) @ FORWARD[:3, :3] for each in (points, later)]
    a, b = (each / np.linalg.norm(each, axis=-1, keepdims=True) for each in rays)
    matches = EpipolarResiduals(np.zeros(len(a), dtype=np.int64), a, b, np.full(len(a), FOCAL))
    return stands(matches, np.broadcast_to(FORWARD, (len(a), 4, 4)))


def street(far: int, road: int) -> Array:
    """Houses far away, and points of the road near the vehicle."""
    random = np.random.default_rng(1)
    houses = random.uniform((60, -40, 2), (150, 40, 12), (far, 3))
    return np.concatenate([houses, random.uniform((5, -4, 0), (12, 4, 0), (road, 3))])


def test_a_vehicle_stands_although_one_car_moves() -> None:
    points = street(80, 20)
    moved = np.where(np.arange(100) >= 92, 2.0, 0.0)  # 8 of the 20 near points
    assert seen(points, moved)
    assert not seen(points, np.full(100, 2.0))


def test_a_creeping_vehicle_does_not_stand() -> None:
    assert not seen(street(180, 20), np.full(200, 0.07))  # 90 % of the points stay, but not those of the road
    assert seen(street(180, 20), np.full(200, 0.001))


def test_few_points_do_not_tell_that_a_vehicle_stands() -> None:
    assert not seen(street(20, 0), np.zeros(20))
