"""The BEV cells that the cameras of a rig see, and the rig next to nuScenes': published weights know no other one."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import Finding
from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.cameras import Camera, CameraRig
from bevcli.geometry.transforms import Array, apply
from bevcli.rig.rig_checks import mounting_of, seen_fov_deg, side_of

COVERAGE_GRID = BevGrid(rows=100, columns=100)
UNSEEN_WARNING = 0.02
ADVICE = "expect worse results with published weights, or train on this rig"


@dataclass(frozen=True)
class Coverage:
    """The cells of a BEV grid that the cameras see."""

    grid: BevGrid  # the BEV grid
    counts: NDArray[np.int64]  # (rows, columns), the number of cameras that see at least one point of the cell's pillar
    shares: Mapping[str, float]  # by camera, the share of all cells that it sees, 0 to 1

    @property
    def unseen(self) -> float:
        """The share of cells that no camera sees, 0 to 1."""
        return float((self.counts == 0).mean())

    @property
    def overlap(self) -> float:
        """The share of cells that two or more cameras see, 0 to 1."""
        return float((self.counts >= 2).mean())


def pixels_in_image(camera: Camera, points_ego: Array) -> Array:
    """Points (..., 3) in the ego frame -> pixels (..., 2), NaN for points outside the image."""
    pixels, depth = camera.project_ego(points_ego)
    return np.where(camera.contains(pixels, depth)[..., None], pixels, np.nan)


def coverage_of(rig: CameraRig, grid: BevGrid = COVERAGE_GRID) -> Coverage:
    """The coverage of a grid by a rig, with all images taken at the same time and without occlusion."""
    pillars = apply(rig.ego_from_bev, grid.pillars())  # (Y, X, Z, 3)
    counts = np.zeros((grid.rows, grid.columns), dtype=np.int64)
    shares = {}
    for camera in rig.cameras:
        seen = camera.sees(pillars).any(-1)  # (Y, X)
        counts += seen
        shares[camera.name] = float(seen.mean())
    return Coverage(grid, counts, shares)


def check_coverage(coverage: Coverage, ego_from_bev: Array) -> tuple[Finding, ...]:
    """One finding if some cells are seen by no camera; no error, because a rig may have few cameras on purpose."""
    if coverage.unseen == 0:
        return ()
    empty = coverage.grid.cell_centers()[coverage.counts == 0]
    center = np.append(empty.mean(0), 0) @ ego_from_bev[:3, :3].T
    yaw = float(np.degrees(np.arctan2(center[1], center[0])))
    around = np.hypot(center[0], center[1]) < 0.1 * (coverage.grid.x_range_m[1] - coverage.grid.x_range_m[0])
    side = "all around" if around else f"mostly {side_of(yaw)}"
    return (
        Finding(
            "cells-unseen", "warning" if coverage.unseen > UNSEEN_WARNING else "info", None,
            "some BEV cells are seen by no camera",
            f"{coverage.unseen:.1%} of the cells, {side}", "0%", "nothing is detected there: see the coverage map",
        ),
    )  # fmt: skip


@dataclass(frozen=True)
class Measure:
    """One property of a rig, as a range over its cameras."""

    code: str  # of the finding when the property is far from nuScenes'
    name: str  # of the property
    unit: str  # of all numbers
    lowest: float  # smallest value of any camera
    highest: float  # largest value of any camera
    nuscenes: tuple[float, float]  # lowest and highest in nuScenes
    near: tuple[float, float]  # range of values that is similar to nuScenes

    @property
    def is_near(self) -> bool:
        """True if every camera is in the range that is similar to nuScenes."""
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
    rows: tuple[tuple[str, str, str, list[float], tuple[float, float], tuple[float, float]], ...] = (
        ("height-far", "camera height", "m", [m.height for m in mountings], (1.49, 1.57), (1.0, 2.2)),
        ("pitch-far", "pitch", "°", [m.pitch_deg for m in mountings], (0.3, 1.2), (-8.0, 8.0)),
        ("roll-far", "roll", "°", [m.roll_deg for m in mountings], (-0.6, 0.9), (-6.0, 6.0)),
        ("fov-far", "field of view", "°", fovs, (64.9, 90.1), (45.0, 115.0)),
        ("cells-seen", "cells seen", "%", [seen], (99.8, 99.8), (95.0, 100.0)),
        ("overlap-far", "cells seen twice", "%", [overlap], (13.8, 13.8), (5.0, 40.0)),
    )
    return tuple(
        Measure(code, name, unit, float(np.min(values)), float(np.max(values)), nuscenes, near)
        for code, name, unit, values, nuscenes, near in rows
    )


def check_measures(measures: Sequence[Measure]) -> tuple[Finding, ...]:
    """A warning for every property that is far from nuScenes', but for unseen cells: `check_coverage` reports them."""
    far = [measure for measure in measures if not measure.is_near and measure.code != "cells-seen"]
    return tuple(
        Finding(m.code, "warning", None, f"{m.name}: far from nuScenes'", m.value, m.reference, ADVICE) for m in far
    )


def _range_text(low: float, high: float, unit: str) -> str:
    digits = 2 if unit == "m" else 1
    first, last = (f"{round(value, digits) + 0.0:.{digits}f}" for value in (low, high))  # + 0.0: zero has no sign
    gap = " " if unit == "m" else ""
    return f"{first}{gap}{unit}" if first == last else f"{first} to {last}{gap}{unit}"
