"""The BEV grid: conversion between cells and metres in the bev frame, and the pillars' heights."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from bevcli.geometry.transforms import Array
from bevcli.parsing.documents import Count


@dataclass(frozen=True)
class BevGrid:
    """A regular grid in the bev frame. Cell (row, column) has the index row * columns + column.

    Attributes:
        rows: number of cells along y; row 0 has the smallest y.
        columns: number of cells along x; column 0 has the smallest x.
        x_range_m: smallest and largest x of the grid, metres.
        y_range_m: smallest and largest y of the grid, metres.
        z_range_m: lower and upper end of the pillars, metres.
        pillar_points: number Z of reference points in a pillar.
    """

    rows: Count
    columns: Count
    x_range_m: tuple[float, float] = (-51.2, 51.2)
    y_range_m: tuple[float, float] = (-51.2, 51.2)
    z_range_m: tuple[float, float] = (-5.0, 3.0)
    pillar_points: Count = 4

    @property
    def cell_size_m(self) -> tuple[float, float]:
        """Size of a cell along x and y, metres."""
        (x0, x1), (y0, y1) = self.x_range_m, self.y_range_m
        return (x1 - x0) / self.columns, (y1 - y0) / self.rows

    @property
    def nearest_side_m(self) -> float:
        """Distance from the origin of the bev frame to the nearest side of the grid, metres."""
        return min(abs(end) for end in (*self.x_range_m, *self.y_range_m))

    def cell_centers(self) -> Array:
        """(rows, columns, 2) x and y of the cells' centres, metres."""
        size_x, size_y = self.cell_size_m
        x = self.x_range_m[0] + (np.arange(self.columns) + 0.5) * size_x
        y = self.y_range_m[0] + (np.arange(self.rows) + 0.5) * size_y
        return np.stack(np.meshgrid(x, y), axis=-1)

    def pillar_heights(self) -> Array:
        """(Z,) heights, metres: evenly spaced from 0.5 m above the lower end to 0.5 m below the upper end."""
        z0, z1 = self.z_range_m
        return z0 + np.linspace(0.5, (z1 - z0) - 0.5, self.pillar_points)

    def pillars(self) -> Array:
        """(rows, columns, Z, 3) the 3D reference points of every cell in the bev frame, metres."""
        centers, heights = self.cell_centers(), self.pillar_heights()
        points = np.empty((self.rows, self.columns, self.pillar_points, 3))
        points[..., :2] = centers[:, :, None, :]
        points[..., 2] = heights
        return points

    def cell_of(self, points_xy: ArrayLike) -> np.ndarray:
        """Row and column (..., 2) int64 of points (..., 2) in metres; -1, -1 for a point outside the grid."""
        p = np.asarray(points_xy, dtype=np.float64)
        low = np.array([self.x_range_m[0], self.y_range_m[0]])
        cell = np.floor((p - low) / np.array(self.cell_size_m))[..., ::-1]
        inside = ((cell >= 0) & (cell < np.array([self.rows, self.columns]))).all(-1)
        return np.where(inside[..., None], cell, -1).astype(np.int64)  # here, as infinity is no integer


def rectangle(x_range_m: tuple[float, float], y_range_m: tuple[float, float]) -> Array:
    """(4, 3) corners of an area at z = 0, metres: counter-clockwise from the smallest x and y."""
    (x0, x1), (y0, y1) = x_range_m, y_range_m
    return np.array([[x0, y0, 0], [x1, y0, 0], [x1, y1, 0], [x0, y1, 0]])
