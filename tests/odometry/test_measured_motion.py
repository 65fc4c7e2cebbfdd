"""The types of a measured motion: poses, poses between frames, and the drive with them."""

import numpy as np
import pytest
from scipy.linalg import expm, logm

from bevcli.geometry.transforms import rigid, rotation_about_z
from bevcli.workshop.odometry.measure import MeasuredMotion, MeasuredStep
from bevcli.workshop.odometry.step_views import exponential, logarithm

SECOND = 1_000_000_000


def circle(steps: int) -> MeasuredMotion:
    """A vehicle on a circle of radius 10 m, anticlockwise, 0.2 radians a step of half a second."""
    step = rigid((10 * np.sin(0.2), 10 * (1 - np.cos(0.2)), 0), rotation_about_z(0.2))
    times = np.arange(steps + 1, dtype=np.int64) * SECOND // 2
    return MeasuredMotion("circle", times, (MeasuredStep(step, np.eye(6)),) * steps)


@pytest.mark.parametrize("twist", [(0.3, -0.2, 0.5, 4, 1, -0.5), (0, 0, 1e-10, 1, 2, 3), (0, 0, 0, 0, 0, 0)])
def test_exponential_is_that_of_matrices(twist: tuple[float, ...]) -> None:
    a, b, c, *velocity = twist
    generator = np.zeros((4, 4))
    generator[:3] = np.column_stack([[[0, -c, b], [c, 0, -a], [-b, a, 0]], velocity])
    motion = exponential(np.array(twist))
    np.testing.assert_allclose(motion, expm(generator), atol=1e-9)
    np.testing.assert_allclose(logarithm(motion), twist, atol=1e-9)
    np.testing.assert_allclose(np.real(logm(motion)), generator, atol=1e-7)


def test_poses_lie_on_the_circle_at_and_between_frames() -> None:
    motion = circle(8)
    np.testing.assert_allclose(motion.poses[0], np.eye(4))
    centre = np.array([0, 10, 0])
    for time in range(-SECOND // 10, 4 * SECOND + SECOND // 10, SECOND // 40):
        pose, angle = motion.ego_motion.pose_at(time), 0.4 * time / SECOND
        np.testing.assert_allclose(pose.translation - centre, [10 * np.sin(angle), -10 * np.cos(angle), 0], atol=2e-3)
        assert pose.yaw == pytest.approx(angle, abs=1e-6)


def test_kinematics_are_those_of_the_circle() -> None:
    at = circle(8).ego_motion.kinematics_at(2 * SECOND)
    np.testing.assert_allclose(at.velocity, [4, 0, 0], atol=0.05)
    np.testing.assert_allclose(at.angular_rate, [0, 0, 0.4], atol=0.01)
    np.testing.assert_allclose(at.acceleration, [0, 1.6, 9.81], atol=0.05)


def test_the_measured_road_is_that_of_each_frame() -> None:
    """A vehicle that pitches by 1°, nose down, from its second frame on: the direction up from the road is aft then."""
    angle = np.radians(1.0)
    pitched = rigid((2, 0, 0), [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    aft = np.array([-np.sin(angle), 0, np.cos(angle)])
    still = MeasuredStep(rigid((2, 0, 0)), np.eye(6), road=aft)
    steps = MeasuredStep(pitched, np.eye(6), road=aft), still
    motion = MeasuredMotion("brakes", np.arange(3, dtype=np.int64) * SECOND, steps).ego_motion
    for second, expected in enumerate([(0, 0, 1), aft, aft]):
        np.testing.assert_allclose(motion.road_normal_at(second * SECOND), expected, atol=1e-12)
    np.testing.assert_allclose(motion.of_rows(np.arange(3)).road_normal_at(0), (0, 0, 1), atol=1e-3)
