"""Rigid motions as twists: the motion along a part of a step is the exponential of that part of its twist."""

import numpy as np
from scipy.spatial.transform import Rotation

from bevcli.geometry.transforms import Array, rigid

SMALLEST = 1e-8  # radians; below it an arc is a line


def _skew(vector: Array) -> Array:
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _along(turn: Array) -> Array:
    """(3, 3) from the velocity of a unit of time to the translation of an arc with a turn (3,)."""
    angle, skew = float(np.linalg.norm(turn)), _skew(turn)
    if angle < SMALLEST:
        return np.eye(3) + skew / 2
    return np.asarray(
        np.eye(3) + (1 - np.cos(angle)) / angle**2 * skew + (angle - np.sin(angle)) / angle**3 * skew @ skew
    )


def exponential(twist: Array) -> Array:
    """(4, 4) the motion of a twist (6,): rotation vector (radians) and velocity (metres) of a unit of time."""
    return rigid(_along(twist[:3]) @ twist[3:], Rotation.from_rotvec(twist[:3]).as_matrix())


def logarithm(motion: Array) -> Array:
    """(6,) the twist of a motion (4, 4): its inverse."""
    turn = Rotation.from_matrix(motion[:3, :3]).as_rotvec()
    return np.concatenate([turn, np.linalg.solve(_along(turn), motion[:3, 3])])
