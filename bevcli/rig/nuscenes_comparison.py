"""The rig next to nuScenes': published weights were trained on no other rig."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bevcli.findings import Finding
from bevcli.geometry.cameras import Camera
from bevcli.rig.coverage import Coverage
from bevcli.rig.mounting import mounting_of, seen_fov_deg

ADVICE = "expect worse results with published weights, or train on this rig"


@dataclass(frozen=True)
class Measure:
    """One property of a rig, as a range over its cameras.

    Attributes:
        code: of the finding when the property is far from nuScenes'.
        name: of the property.
        unit: of all numbers.
        lowest: smallest value of any camera.
        highest: largest value of any camera.
        nuscenes: lowest and highest in nuScenes.
        near: range of values that is similar to nuScenes.
    """

    code: str
    name: str
    unit: str
    lowest: float
    highest: float
    nuscenes: tuple[float, float]
    near: tuple[float, float]

    @property
    def is_near(self) -> bool:
        """Whether every camera is in the range that is similar to nuScenes."""
        return self.near[0] <= self.lowest and self.highest <= self.near[1]

    @property
    def value(self) -> str:
        """The range as text, such as "1.49 to 1.57 m"."""
        return _range_text(self.lowest, self.highest, self.unit)

    @property
    def reference(self) -> str:
        """nuScenes' range as text."""
        return _range_text(*self.nuscenes, self.unit)


def measures_of(cameras: Sequence[Camera], coverage: Coverage) -> tuple[Measure, ...]:
    """Height, pitch, roll, field of view and overlap of a rig with at least one camera.

    nuScenes' values were measured with these functions on one of its vehicles.
    """
    mountings = [mounting_of(camera.ego_from_camera) for camera in cameras]
    fovs = [seen_fov_deg(camera)[0] for camera in cameras]
    seen, overlap = 100 * (1 - coverage.unseen), 100 * coverage.overlap
    return (
        _measure("height-far", "camera height", "m", [m.height for m in mountings], (1.49, 1.57), (1.0, 2.2)),
        _measure("pitch-far", "pitch", "°", [m.pitch_deg for m in mountings], (0.3, 1.2), (-8.0, 8.0)),
        _measure("roll-far", "roll", "°", [m.roll_deg for m in mountings], (-0.6, 0.9), (-6.0, 6.0)),
        _measure("fov-far", "field of view", "°", fovs, (64.9, 90.1), (45.0, 115.0)),
        _measure("cells-seen", "cells seen", "%", [seen], (99.8, 99.8), (95.0, 100.0)),
        _measure("overlap-far", "cells seen twice", "%", [overlap], (13.8, 13.8), (5.0, 40.0)),
    )


def check_measures(measures: Sequence[Measure]) -> tuple[Finding, ...]:
    """A warning for every property that is far from nuScenes'.

    Cells that no camera sees are left out: `check_coverage` reports them.
    """
    far = [measure for measure in measures if not measure.is_near and measure.code != "cells-seen"]
    return tuple(
        Finding(m.code, "warning", None, f"{m.name}: far from nuScenes'", m.value, m.reference, ADVICE) for m in far
    )


def _measure(
    code: str, name: str, unit: str, values: Sequence[float], nuscenes: tuple[float, float], near: tuple[float, float]
) -> Measure:
    return Measure(code, name, unit, float(np.min(values)), float(np.max(values)), nuscenes, near)


def _range_text(low: float, high: float, unit: str) -> str:
    digits = 2 if unit == "m" else 1
    first, last = (f"{round(value, digits) + 0.0:.{digits}f}" for value in (low, high))  # + 0.0: zero has no sign
    gap = " " if unit == "m" else ""
    return f"{first}{gap}{unit}" if first == last else f"{first} to {last}{gap}{unit}"
