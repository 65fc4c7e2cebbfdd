"""Reading numbers out of JSON: what is wrong is reported as findings, so that one reader serves strict and lenient."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from bevcli.findings import Finding
from bevcli.geometry.transforms import Array


@dataclass(frozen=True)
class Report:
    """Collects findings about one camera, or about the whole file where camera is None.

    prefix: the key around the fields at hand, as "ego_from_camera.".
    """

    camera: str | None = None
    prefix: str = ""
    findings: list[Finding] = field(default_factory=list)

    def about(self, camera: str) -> Report:
        """A report on one camera, into the same list."""
        return replace(self, camera=camera)

    def within(self, name: str) -> Report:
        """A report on the fields inside the field `name`, into the same list."""
        return replace(self, prefix=f"{self.prefix}{name}.")

    def error(
        self, code: str, name: str, message: str, *, expected: str = "", found: object = "", advice: str = ""
    ) -> None:
        """Add a finding of severity error on the field `name`; `message` goes on from its name."""
        text = f'"{self.prefix}{name}" {message}'
        self.findings.append(Finding(code, "error", self.camera, text, shortened(found), expected, advice))

    def missing(self, name: str, expected: str) -> None:
        """Add that a key is missing."""
        self.error("missing-key", name, "is missing", expected=expected)


def parse_numbers(owner: Mapping[str, Any], name: str, shape: tuple[int, ...], report: Report) -> Array | None:
    """The array of finite numbers under a key, of exactly this shape; else None, and why is reported."""
    expected = "x".join(map(str, shape)) if len(shape) > 1 else f"{shape[0]} numbers"
    value = owner.get(name)
    if value is None:
        report.missing(name, expected)
        return None
    array = _array_of_numbers(value)
    if array is None:
        report.error("wrong-shape", name, "is not all numbers", expected=expected, found=value)
        return None
    if array.shape != shape:
        found = "x".join(map(str, array.shape)) or value
        report.error("wrong-shape", name, "has the wrong shape", expected=expected, found=found)
        return None
    if not np.isfinite(array).all():
        report.error("not-finite", name, "holds NaN or infinity", expected="finite numbers", found=value)
        return None
    return array


def shortened(value: object) -> str:
    """The value as text of at most 60 characters."""
    text = str(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _array_of_numbers(value: object) -> Array | None:
    try:
        array = np.array(value)
    except ValueError:  # rows of different lengths
        return None
    return array.astype(np.float64) if array.dtype.kind in "iuf" else None
