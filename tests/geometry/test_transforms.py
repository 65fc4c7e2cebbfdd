import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bevcli.geometry.transforms import (
    Pose,
    apply,
    interpolate,
    inverse,
    quaternion_from_rotation,
    rigid,
    rotation_from_quaternion,
    wrap_angle,
    yaw_of_quaternion,
)

RANDOM = np.random.default_rng(1)


def random_quaternions(count):
    quaternions = RANDOM.normal(size=(count, 4))
    return quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)


@pytest.mark.parametrize("quaternion", random_quaternions(20))
def test_rotation_agrees_with_scipy_both_ways(quaternion):
    expected = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    assert rotation_from_quaternion(quaternion) == pytest.approx(expected, abs=1e-12)
    back = quaternion_from_rotation(expected)
    assert back[0] >= 0
    assert np.abs(back @ quaternion) == pytest.approx(1)


def test_inverse_undoes_a_transform():
    a_from_b = rigid((1, -2, 3), rotation_from_quaternion(random_quaternions(1)[0]))
    points = RANDOM.normal(size=(7, 3))
    assert apply(inverse(a_from_b), apply(a_from_b, points)) == pytest.approx(points)
    assert inverse(np.stack([a_from_b, np.eye(4)]))[0] @ a_from_b == pytest.approx(np.eye(4))


def test_yaw_counts_counter_clockwise_from_x():
    half = np.radians(30) / 2
    assert yaw_of_quaternion((np.cos(half), 0, 0, np.sin(half))) == pytest.approx(np.radians(30))
    assert yaw_of_quaternion((-np.cos(half), 0, 0, -np.sin(half))) == pytest.approx(np.radians(30))


def test_interpolation_takes_the_shorter_arc_and_the_first_sign():
    start = Pose(np.zeros(3), np.array([-np.cos(0.1), 0, 0, -np.sin(0.1)]))  # yaw 0.2, stored with w < 0
    end = Pose(np.array([2.0, 0, 0]), np.array([np.cos(0.3), 0, 0, np.sin(0.3)]))  # yaw 0.6
    middle = interpolate(start, end, 0.5)
    assert middle.translation == pytest.approx([1, 0, 0])
    assert middle.yaw == pytest.approx(0.4)
    assert middle.quaternion[0] < 0


def test_wrapped_angles_differ_by_whole_turns():
    angles = np.linspace(-20, 20, 101)
    wrapped = wrap_angle(angles)
    assert (wrapped >= -np.pi).all()
    assert (wrapped < np.pi).all()
    assert np.cos(wrapped) == pytest.approx(np.cos(angles))
    assert np.sin(wrapped) == pytest.approx(np.sin(angles))
