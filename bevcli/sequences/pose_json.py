"""A pose as JSON: {"translation": [x, y, z], "rotation_wxyz": [w, x, y, z]}, or "rotation": a 3x3 matrix."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bevcli.errors import InputError
from bevcli.geometry.transforms import Array, Pose, quaternion_from_rotation

ROTATION_TOLERANCE = 1e-3  # how far a quaternion's norm, or R R^T from the identity, may be off


def pose_from_json(value: Any, where: str) -> Pose:
    """Read a pose; a stored quaternion keeps its sign.

    where: what stands before the message ("boxes.json: frame 3: world_from_ego"). Raises InputError.
    """
    if not isinstance(value, dict):
        raise InputError(f'{where}: expected an object with "translation" and "rotation_wxyz", found {value!r:.40}')
    translation = _finite(value.get("translation"), (3,), f"{where}: translation")
    if ("rotation_wxyz" in value) == ("rotation" in value):
        raise InputError(f'{where}: expected either "rotation_wxyz" or "rotation" (found: {", ".join(value)})')
    if "rotation" in value:
        return Pose(translation, _quaternion_of_matrix(value["rotation"], f"{where}: rotation"))
    quaternion = _finite(value["rotation_wxyz"], (4,), f"{where}: rotation_wxyz")
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1) > ROTATION_TOLERANCE:
        raise InputError(f"{where}: rotation_wxyz has norm {norm:.6g} (expected 1): normalise it, order w, x, y, z")
    return Pose(translation, quaternion)


def pose_to_json(pose: Pose) -> dict[str, list[float]]:
    """The pose as `pose_from_json` reads it."""
    return {"translation": pose.translation.tolist(), "rotation_wxyz": pose.quaternion.tolist()}


def _quaternion_of_matrix(value: ArrayLike, where: str) -> Array:
    matrix = _finite(value, (3, 3), where)
    error = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
    if error > ROTATION_TOLERANCE or np.linalg.det(matrix) < 0:
        raise InputError(f"{where}: not a right-handed rotation (R R^T differs from the identity by {error:.3g})")
    return quaternion_from_rotation(matrix)


def _finite(value: Any, shape: tuple[int, ...], where: str) -> Array:
    size = "x".join(map(str, shape))
    if value is None:
        raise InputError(f"{where}: missing (expected {size} numbers)")
    try:
        array = np.asarray(value)
    except ValueError:  # ragged lists
        array = np.asarray(None)
    if array.shape != shape or array.dtype.kind not in "iuf":
        raise InputError(f"{where}: expected {size} numbers, found {value!r:.60}")
    if not np.isfinite(array).all():
        raise InputError(f"{where}: expected finite numbers, found {value!r:.60}")
    return array.astype(np.float64)
