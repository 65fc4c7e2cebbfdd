"""Coverage: which cells of the BEV grid the cameras see. The model has no input for the others."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bevcli.findings import Finding
from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.cameras import Camera, CameraRig
from bevcli.geometry.transforms import Array, apply
from bevcli.rig.name_checks import side_of

COVERAGE_GRID = BevGrid(rows=100, columns=100)
UNSEEN_WARNING = 0.02


@dataclass(frozen=True)
class Coverage:
    """How much of a BEV grid the cameras see.

    Attributes:
        grid: the BEV grid.
        counts: (rows, columns), the number of cameras that see at least one point of the cell's pillar.
        shares: by camera, the share of all cells that it sees, 0 to 1.
    """

    grid: BevGrid
    counts: NDArray[np.int64]
    shares: Mapping[str, float]

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
        seen = np.isfinite(pixels_in_image(camera, pillars)).all(-1).any(-1)  # (Y, X)
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
