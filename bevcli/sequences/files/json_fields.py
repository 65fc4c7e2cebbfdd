"""Reads numbers from JSON objects and collects what is wrong as findings.

`bevcli run` stops at the first finding; `bevcli project-debug` shows all of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from bevcli.findings import Finding
from bevcli.geometry.transforms import Array

LARGEST_NUMBER = 1e12


@dataclass(frozen=True)
class Report:
    """Collects findings while a file is read.

    Attributes:
        camera: the camera that the fields belong to, None for the whole file.
        prefix: path of the enclosing keys, such as "ego_from_camera.".
        findings: the findings so far; reports made by `about` and `within` share the list.
    """

    camera: str | None = None
    prefix: str = ""
    findings: list[Finding] = field(default_factory=list)

    def about(self, camera: str) -> Report:
        """A report on one camera that adds to the same findings."""
        return replace(self, camera=camera)

    def within(self, name: str) -> Report:
        """A report on the fields inside the field `name` that adds to the same findings."""
        return replace(self, prefix=f"{self.prefix}{name}.")

    def error(
        self, code: str, name: str, message: str, *, expected: str = "", found: object = "", advice: str = ""
    ) -> None:
        """Add an error about the field `name`. `message` continues a sentence that begins with the name."""
        text = f'"{self.prefix}{name}" {message}'
        self.findings.append(Finding(code, "error", self.camera, text, shortened(found), expected, advice))

    def missing(self, name: str, expected: str) -> None:
        """Add an error for a missing key."""
        self.error("missing-key", name, "is missing", expected=expected)


def parse_numbers(owner: Mapping[str, Any], name: str, shape: tuple[int, ...], report: Report) -> Array | None:
    """The array of finite numbers with this shape under the key `name`; None, with a finding, if it is invalid."""
    expected = "x".join(map(str, shape)) if len(shape) > 1 else f"{shape[0]} numbers"
    value = owner.get(name)
    if value is None:
        report.missing(name, expected)
        return None
    array = _array_of_numbers(value)
    if array is None:
        report.error("wrong-shape", name, "is not an array of numbers", expected=expected, found=value)
        return None
    if array.shape != shape:
        found = "x".join(map(str, array.shape)) or value
        report.error("wrong-shape", name, "has the wrong shape", expected=expected, found=found)
        return None
    if not (np.abs(array) < LARGEST_NUMBER).all():
        report.error("not-finite", name, "contains NaN or infinity", expected="finite numbers below 1e12", found=value)
        return None
    return array


def shortened(value: object) -> str:
    """The value as text of at most 60 characters."""
    text = str(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _array_of_numbers(value: object) -> Array | None:
    try:
        array = np.array(value)
    except (ValueError, OverflowError):  # rows of different lengths
        return None
    return array.astype(np.float64) if array.dtype.kind in "iuf" else None
