"""Rigid motions as twists: the motion along a part of a step is the exponential of that part of its twist."""

import numpy as np
from scipy.spatial.transform import Rotation

from bevcli.geometry.transforms import Array

SMALLEST = 1e-7  # radians; below it an arc is a line


def _skew(vectors: Array) -> Array:
    """(..., 3, 3) of vectors (..., 3): the matrix of the cross product."""
    return np.asarray(np.cross(vectors[..., None, :], np.eye(3)).swapaxes(-1, -2))


def _along(turn: Array) -> Array:
    """(..., 3, 3) from the velocity of a unit of time to the translation of an arc with a turn (..., 3)."""
    angle, skew = np.linalg.norm(turn, axis=-1)[..., None, None], _skew(turn)
    safe = np.maximum(angle, SMALLEST)
    first = np.where(angle < SMALLEST, 0.5, (1 - np.cos(safe)) / safe**2)
    second = np.where(angle < SMALLEST, 0.0, (safe - np.sin(safe)) / safe**3)
    return np.asarray(np.eye(3) + first * skew + second * skew @ skew)


def exponential(twist: Array) -> Array:
    """(..., 4, 4) the motions of twists (..., 6): rotation vector (radians) and velocity (metres) of a unit of time."""
    motion = np.zeros((*twist.shape[:-1], 4, 4))
    motion[..., :3, :3] = (
        Rotation.from_rotvec(twist[..., :3].reshape(-1, 3)).as_matrix().reshape(*twist.shape[:-1], 3, 3)
    )
    motion[..., :3, 3] = (_along(twist[..., :3]) @ twist[..., 3:, None])[..., 0]
    motion[..., 3, 3] = 1
    return motion


def logarithm(motion: Array) -> Array:
    """(6,) the twist of a motion (4, 4): its inverse."""
    turn = Rotation.from_matrix(motion[:3, :3]).as_rotvec()
    return np.concatenate([turn, np.linalg.solve(_along(turn), motion[:3, 3])])
