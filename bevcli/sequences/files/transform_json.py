"""Rigid transforms in JSON: "translation" and either "rotation_wxyz" or "rotation" (a 3x3 matrix)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.transforms import Array, Pose, rigid, rotation_from_quaternion
from bevcli.sequences.files.json_fields import Report, parse_numbers

TOLERANCE = 1e-3  # largest deviation of a quaternion's norm from 1, and of R Rᵀ from the identity


def parse_transform(owner: Mapping[str, Any], name: str, report: Report) -> Array | None:
    """(4, 4) of {"translation": [x, y, z], "rotation_wxyz": [w, x, y, z] or "rotation": 3x3}, metres.

    An invalid rotation is reported and replaced by the nearest valid one. None if that is not possible.

    owner: the JSON object that holds the transform under the key `name`.
    """
    value = owner.get(name)
    if value is None:
        report.missing(name, '{"translation": [x, y, z], "rotation_wxyz": [w, x, y, z]}')
        return None
    if not isinstance(value, dict):
        expected = '{"translation": [x, y, z], "rotation_wxyz": [w, x, y, z]}'
        report.error("wrong-shape", name, "is not a transform", expected=expected, found=value)
        return None
    inside = report.within(name)
    translation, rotation = parse_numbers(value, "translation", (3,), inside), _parse_rotation(value, inside)
    return None if translation is None or rotation is None else rigid(translation, rotation)


def transform_to_json(a_from_b: Array) -> dict[str, Any]:
    """The transform (4, 4) as JSON. The rotation is written as a matrix, so that reading returns the same numbers."""
    return {"translation": a_from_b[:3, 3].tolist(), "rotation": a_from_b[:3, :3].tolist()}


def pose_from_json(value: Any, name: str, where: str) -> Pose:
    """The pose of a transform in JSON. A quaternion keeps its sign.

    name: the key of the value. where: start of an error message, such as "boxes.json: frame 3".
    Raises InputError for a transform that is missing or invalid.
    """
    report = Report()
    matrix = parse_transform({name: value}, name, report)
    if report.findings or matrix is None:
        raise InputError(f"{where}: {report.findings[0].line}")
    if "rotation_wxyz" not in value:
        return Pose.from_matrix(matrix)
    return Pose(matrix[:3, 3], np.array(value["rotation_wxyz"], dtype=np.float64))


def pose_to_json(pose: Pose) -> dict[str, list[float]]:
    """The pose in JSON, as `pose_from_json` reads it."""
    return {"translation": pose.translation.tolist(), "rotation_wxyz": pose.quaternion.tolist()}


def _parse_rotation(pose: Mapping[str, Any], report: Report) -> Array | None:
    if "rotation" not in pose:
        quaternion = parse_numbers(pose, "rotation_wxyz", (4,), report)
        return None if quaternion is None else _rotation_of(quaternion, report)
    if "rotation_wxyz" in pose:
        report.error("rotation-twice", "rotation", 'is given in addition to "rotation_wxyz"', expected="one of them")
        return None
    matrix = parse_numbers(pose, "rotation", (3, 3), report)
    return None if matrix is None else _checked(matrix, report)


def _rotation_of(quaternion: Array, report: Report) -> Array | None:
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1) > TOLERANCE:
        report.error(
            "quaternion-norm", "rotation_wxyz", "is not a rotation: its norm is not 1",
            expected="1 ± 0.001", found=f"{norm:.6g}",
            advice="check for missing or rounded digits; the order is w, x, y, z",
        )  # fmt: skip
    return rotation_from_quaternion(quaternion) if norm > TOLERANCE else None


def _checked(matrix: Array, report: Report) -> Array | None:
    """The matrix (3, 3), or the nearest rotation if it is not a rotation; None if it is singular."""
    deviation = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
    if deviation > TOLERANCE:
        report.error(
            "rotation-not-orthonormal", "rotation", "is not orthonormal",
            expected="R Rᵀ = identity within 0.001", found=f"off by {deviation:.3g}",
            advice="check for rounded digits, a scale factor, or another matrix in its place",
        )  # fmt: skip
    elif np.linalg.det(matrix) < 0:
        report.error(
            "rotation-left-handed", "rotation", "is left-handed", expected="determinant 1", found="determinant -1",
            advice="an axis is mirrored; camera: x right, y down, z forward; ego: x forward, y left, z up",
        )  # fmt: skip
    else:
        return matrix
    left, singular_values, right = np.linalg.svd(matrix)
    if singular_values[-1] < TOLERANCE:
        return None
    nearest: Array = left @ right
    return nearest if np.linalg.det(nearest) > 0 else nearest * [-1.0, 1.0, 1.0]
