"""Writes BEV maps into a recording: features, segmentation, history weights, probed cells."""

from __future__ import annotations

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from bevcli.frame import BevMap, Probe
from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.transforms import Array, apply
from bevcli.recording import entities
from bevcli.recording.colors import BACKGROUND, colormap, map_colors

GROUND_OPACITY = 110  # of 255: boxes, rings and the trajectory stay readable on the map
BELOW_GROUND_M = 0.06  # the map is drawn below the ground, so that it does not flicker with the range rings


def log_features(stream: rr.RecordingStream, image: NDArray[np.uint8], grid: BevGrid, ego_from_bev: Array) -> None:
    """Writes an image of the BEV features into the BEV view, and onto the ground of the scene.

    image: (rows, columns, 3) RGB; the first row has the largest y.
    """
    stream.log(entities.BEV_FEATURES, rr.Image(image, draw_order=-10), _placed(image, grid.x_range_m, grid.y_range_m))
    ground = _on_ground(image, grid.x_range_m, grid.y_range_m, ego_from_bev, GROUND_OPACITY)
    stream.log(entities.BEV_ON_GROUND, ground)


def log_segmentation(stream: rr.RecordingStream, segmentation: BevMap, ego_from_bev: Array) -> None:
    """Writes a segmentation into the BEV view and onto the ground of the scene, in the colours of the map classes."""
    colors = np.full((*segmentation.cells.shape, 3), BACKGROUND, dtype=np.uint8)
    for name, color in map_colors(segmentation.classes).items():  # where a cell has several, the last one is shown
        colors[segmentation.layer(name)] = color
    image = rr.Image(colors, draw_order=-5)
    stream.log(entities.BEV_SEGMENTATION, image, _placed(colors, segmentation.x_range_m, segmentation.y_range_m))
    ground = _on_ground(colors, segmentation.x_range_m, segmentation.y_range_m, ego_from_bev, 255)
    stream.log(entities.SEGMENTATION_ON_GROUND, ground)


def log_history(stream: rr.RecordingStream, weight: Array | None, grid: BevGrid) -> None:
    """Writes the attention weight of the previous BEV map in each cell.

    weight: (rows, columns) 0 to 1; None (no history was used) clears the map of the frame before.
    """
    if weight is None:
        stream.log(entities.BEV_HISTORY, rr.Clear(recursive=False))
        return
    image = colormap(weight[::-1], "viridis")
    stream.log(entities.BEV_HISTORY, rr.Image(image, draw_order=-8), _placed(image, grid.x_range_m, grid.y_range_m))


def log_probes(stream: rr.RecordingStream, probes: tuple[Probe, ...], ego_from_bev: Array, grid: BevGrid) -> None:
    """Marks the probed cells: with a dot in the BEV view, and with a pillar in the scene."""
    if not probes:
        return
    centers = np.array([probe.cell_center for probe in probes])
    radius = rr.Radius.ui_points(5.0)
    dots = rr.Points2D(centers * (1, -1), colors=[255, 80, 220], radii=radius, draw_order=50)
    stream.log(entities.BEV_PROBES, dots)
    low, high = grid.pillar_heights()[[0, -1]]
    ends = np.stack([np.column_stack([centers, np.full(len(centers), z)]) for z in (low, high)], axis=1)
    stream.log(
        entities.PROBES,
        rr.LineStrips3D(apply(ego_from_bev, ends).astype(np.float32), colors=[255, 80, 220], radii=0.05),
    )


def _placed(image: NDArray[np.uint8], x_range: tuple[float, float], y_range: tuple[float, float]) -> rr.Transform3D:
    rows, columns = image.shape[:2]
    cell = [(x_range[1] - x_range[0]) / columns, (y_range[1] - y_range[0]) / rows, 1.0]
    return rr.Transform3D(translation=[x_range[0], -y_range[1], 0], scale=cell)


def _on_ground(
    image: NDArray[np.uint8],
    x_range: tuple[float, float],
    y_range: tuple[float, float],
    ego_from_bev: Array,
    opacity: int,
) -> rr.Mesh3D:
    """An image of the bev frame, whose first row has the largest y, as a rectangle on the ground of the ego frame."""
    (x0, x1), (y0, y1) = x_range, y_range
    corners = apply(ego_from_bev, [[x0, y0, 0], [x1, y0, 0], [x1, y1, 0], [x0, y1, 0]])
    corners[:, 2] = -BELOW_GROUND_M
    return rr.Mesh3D(
        vertex_positions=corners,
        triangle_indices=[[0, 1, 2], [0, 2, 3]],
        vertex_texcoords=[[0, 1], [1, 1], [1, 0], [0, 0]],
        albedo_texture=image,
        albedo_factor=[255, 255, 255, opacity],
    )
