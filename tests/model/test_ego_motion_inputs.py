"""The model's ego-motion inputs: can-bus numbers, history shift and history rotation."""

from __future__ import annotations

import numpy as np
import pytest

from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.ego_motion import Kinematics
from bevcli.geometry.transforms import Pose
from bevcli.model.ego_motion import EgoMotionConfig, EgoMotionInputs, ego_motion_inputs

GRID = BevGrid(50, 40, x_range_m=(-40, 40), y_range_m=(-50, 50))


def pose(x: float, y: float, yaw_deg: float, sign: float = 1.0) -> Pose:
    half = np.radians(yaw_deg) / 2
    return Pose(np.array([x, y, 0.5]), sign * np.array([np.cos(half), 0, 0, np.sin(half)]))


def inputs_for(now: Pose, before: Pose | None, **settings: object) -> EgoMotionInputs:
    config = EgoMotionConfig(**settings)  # type: ignore[arg-type]
    return ego_motion_inputs(now, before, Kinematics((1, 2, 9.8), (0.1, 0.2, 0.3), (7, 0, 0)), GRID, config)


@pytest.mark.parametrize("yaw_deg", [0, 37, 180, 301])
def test_driving_straight_shifts_history_by_the_distance(yaw_deg: float) -> None:
    ahead = np.array([np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))])
    start, end = np.array([100.0, 200.0]), np.array([100.0, 200.0]) + 5 * ahead
    inputs = inputs_for(pose(*end, yaw_deg), pose(*start, yaw_deg))
    np.testing.assert_allclose(inputs.shift, [0, 5 / 100], atol=1e-7)
    assert inputs.rotation_deg == pytest.approx(0, abs=1e-9)


def test_moving_to_the_right_shifts_history_along_x() -> None:
    inputs = inputs_for(pose(0, -4, 0), pose(0, 0, 0))  # ego x is world x; the right is -y
    np.testing.assert_allclose(inputs.shift, [4 / 80, 0], atol=1e-7)


def test_the_first_frame_of_a_scene_has_no_motion() -> None:
    inputs = inputs_for(pose(411, 1180, 351.5), None)
    assert inputs.rotation_deg == 0
    np.testing.assert_array_equal(inputs.shift, 0)
    np.testing.assert_array_equal(inputs.can_bus[:3], 0)
    assert inputs.can_bus[17] == 0
    assert inputs.can_bus[16] == pytest.approx(np.radians(351.5))


def test_the_can_bus_numbers_have_the_originals_order() -> None:
    inputs = inputs_for(pose(3, 5, 20), pose(1, 1, 10))
    w = np.cos(np.radians(10))
    expected = [2, 4, 0, w, w, w, w, 1, 2, 9.8, 0.1, 0.2, 0.3, 7, 0, 0, np.radians(20), 10]
    np.testing.assert_allclose(inputs.can_bus, expected, rtol=1e-5, atol=1e-6)


def test_the_change_of_heading_is_not_wrapped() -> None:
    assert inputs_for(pose(0, 0, 4), pose(0, 0, 358)).rotation_deg == pytest.approx(-354)


def test_the_sign_of_the_quaternion_is_kept() -> None:
    plus, minus = inputs_for(pose(0, 0, 50), None), inputs_for(pose(0, 0, 50, sign=-1), None)
    assert plus.can_bus[3] == -minus.can_bus[3]
    assert plus.can_bus[16] == minus.can_bus[16]


def test_the_whole_quaternion_is_an_option() -> None:
    now = pose(0, 0, 50)
    np.testing.assert_allclose(inputs_for(now, None, can_bus_quaternion="wxyz").can_bus[3:7], now.quaternion, rtol=1e-6)


def test_shift_and_rotation_can_be_turned_off() -> None:
    inputs = inputs_for(pose(5, 5, 20), pose(0, 0, 0), shift=False, rotation=False)
    np.testing.assert_array_equal(inputs.shift, 0)
    assert inputs.rotation_deg == 0
