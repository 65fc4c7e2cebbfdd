"""A pose in the boxes files' JSON: the transform of `pose_field`, with a stored quaternion's sign kept."""

from __future__ import annotations

from typing import Any

import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.transforms import Pose
from bevcli.sequences.files.field_report import Report
from bevcli.sequences.files.pose_field import parse_transform


def pose_from_json(value: Any, name: str, where: str) -> Pose:
    """Read {"translation": [x, y, z], "rotation_wxyz": [w, x, y, z]}, or "rotation" as a 3x3 matrix.

    name: the key that the value stands under. where: what stands before the message ("boxes.json: frame 3").
    Raises InputError.
    """
    report = Report()
    matrix = parse_transform({name: value}, name, report)
    if report.findings or matrix is None:
        raise InputError(f"{where}: {report.findings[0].line}")
    if "rotation_wxyz" not in value:
        return Pose.from_matrix(matrix)
    return Pose(matrix[:3, 3], np.array(value["rotation_wxyz"], dtype=np.float64))


def pose_to_json(pose: Pose) -> dict[str, list[float]]:
    """The pose as `pose_from_json` reads it."""
    return {"translation": pose.translation.tolist(), "rotation_wxyz": pose.quaternion.tolist()}
