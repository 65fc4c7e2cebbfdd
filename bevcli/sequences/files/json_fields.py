"""Reads numbers from JSON and collects mistakes as findings: `run` stops at the first, `project-debug` shows all."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from bevcli.errors import Finding, InputError
from bevcli.geometry.transforms import Array, Pose, rigid, rotation_from_quaternion
from bevcli.printing import one_line, quoted

LARGEST_NUMBER = 1e12
LONGEST_VALUE = 60  # characters of a value in a message
TOLERANCE = 1e-3  # largest deviation of a quaternion's norm from 1, and of R Rᵀ from the identity
_Value = TypeVar("_Value")


@dataclass(frozen=True)
class Report:
    """Collects findings while a file is read. A function that reads a value returns None for an unusable one."""

    camera: str | None = None  # the camera that the fields belong to, None for the whole file
    prefix: str = ""  # path of the enclosing keys, such as "ego_from_camera."
    # the findings so far; copies made by `replace` share the list
    findings: list[Finding] = field(default_factory=list)

    def error(
        self, code: str, name: str, message: str, *, expected: str = "", found: object = "", advice: str = ""
    ) -> None:
        """Add an error about the field `name`. `message` continues a sentence that begins with the name."""
        text = f'"{self.prefix}{name}" {message}'
        self.findings.append(
            Finding(code, "error", self.camera, text, one_line(found, LONGEST_VALUE), expected, advice)
        )

    def missing(self, name: str, expected: str) -> None:
        """Add an error for a missing key."""
        self.error("missing-key", name, "is missing", expected=expected)


def require(
    parse: Callable[..., _Value | None], *arguments: Any, where: Path | str, camera: str | None = None
) -> _Value:
    """The value that `parse(*arguments, report)` reads. Raises InputError with the first finding, after `where`."""
    report = Report(camera)
    value = parse(*arguments, report)
    for finding in report.findings:
        raise InputError(f"{where}: {finding.line}")
    assert value is not None
    return value


def parse_numbers(owner: Mapping[str, Any], name: str, shape: tuple[int, ...], report: Report) -> Array | None:
    """The array of finite numbers with this shape under the key `name`."""
    expected = "x".join(map(str, shape)) if len(shape) > 1 else f"{shape[0]} numbers"
    value = owner.get(name)
    if value is None:
        report.missing(name, expected)
        return None
    array = array_of_numbers(value)
    if array is None or array.shape != shape:
        message = "is not an array of numbers" if array is None else "has the wrong shape"
        found = quoted(value) if array is None else "x".join(map(str, array.shape)) or value
        report.error("wrong-shape", name, message, expected=expected, found=found)
        return None
    if not (np.abs(array) < LARGEST_NUMBER).all():
        expected = "finite numbers below 1e12"
        report.error("not-finite", name, "contains NaN or infinity", expected=expected, found=value)
        return None
    return array


def array_of_numbers(value: object) -> Array | None:
    """The float64 array of a number or of nested lists of numbers; None for anything else."""
    try:
        array = np.array(value)
    except (ValueError, OverflowError):  # rows of different lengths
        return None
    if array.dtype.kind not in "iuf" or any(isinstance(each, bool) for each in np.array(value, object).flat):
        return None
    return array.astype(np.float64, copy=False)


def parse_transform(owner: Mapping[str, Any], name: str, report: Report) -> Array | None:
    """(4, 4) of {"translation": [x, y, z], "rotation_wxyz": [w, x, y, z] or "rotation": 3x3}, metres.

    An invalid rotation is reported and replaced by the nearest valid one, where there is one.

    owner: the JSON object that holds the transform under the key `name`.
    """
    value = owner.get(name)
    expected = '{"translation": [x, y, z], "rotation_wxyz": [w, x, y, z]}'
    if value is None:
        report.missing(name, expected)
        return None
    if not isinstance(value, dict):
        report.error("wrong-shape", name, "is not a transform", expected=expected, found=quoted(value))
        return None
    inside = replace(report, prefix=f"{name}.")
    translation, rotation = parse_numbers(value, "translation", (3,), inside), None
    if "rotation" not in value:
        quaternion = parse_numbers(value, "rotation_wxyz", (4,), inside)
        norm = 0.0 if quaternion is None else float(np.linalg.norm(quaternion))
        if quaternion is not None and abs(norm - 1) > TOLERANCE:
            inside.error(
                "quaternion-norm", "rotation_wxyz", "is not a rotation: its norm is not 1",
                expected="1 ± 0.001", found=f"{norm:.6g}",
                advice="check for missing or rounded digits; the order is w, x, y, z",
            )  # fmt: skip
        rotation = None if quaternion is None or norm <= TOLERANCE else rotation_from_quaternion(quaternion)
    elif "rotation_wxyz" in value:
        inside.error("rotation-twice", "rotation", 'is given in addition to "rotation_wxyz"', expected="one of them")
    else:
        matrix = parse_numbers(value, "rotation", (3, 3), inside)
        rotation = None if matrix is None else _nearest_rotation(matrix, inside)
    return None if translation is None or rotation is None else rigid(translation, rotation)


def transform_to_json(a_from_b: Array) -> dict[str, Any]:
    """The transform (4, 4) as JSON. The rotation is written as a matrix, so that reading returns the same numbers."""
    return {"translation": a_from_b[:3, 3].tolist(), "rotation": a_from_b[:3, :3].tolist()}


def pose_from_json(value: Any, name: str, location: str) -> Pose:
    """The pose of a transform in JSON. A quaternion keeps its sign.

    name: the key of the value. where: start of an error message, such as "boxes.json: frame 3".
    Raises InputError for a transform that is missing or invalid.
    """
    matrix = require(parse_transform, {name: value}, name, where=location)
    if "rotation_wxyz" not in value:
        return Pose.from_matrix(matrix)
    return Pose(matrix[:3, 3], np.array(value["rotation_wxyz"], dtype=np.float64))


def pose_to_json(pose: Pose) -> dict[str, list[float]]:
    """The pose in JSON, as `pose_from_json` reads it."""
    return {"translation": pose.translation.tolist(), "rotation_wxyz": pose.quaternion.tolist()}


def _nearest_rotation(matrix: Array, report: Report) -> Array | None:
    """The matrix (3, 3), or the nearest rotation if it is not a rotation. None if it is singular."""
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
