"""The part of a predicted map that cameras see: elsewhere, a model fills in what it has learned about streets."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bevcli.frame import BevMap, Frame
from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.transforms import apply


class SeenCells:
    """The cells of a map that a frame's cameras see. Those of the last rig are kept, as most drives have one."""

    def __init__(self) -> None:
        self._rig: CameraRig | None = None
        self._of_camera: dict[str, NDArray[np.bool_]] = {}

    def of(self, ground_map: BevMap, frame: Frame, grid: BevGrid) -> BevMap:
        """A map in which cells have no class if no camera with an image sees a point of their pillar.

        grid: of the model, for the heights of the pillars' points.
        """
        rows, columns = ground_map.cells.shape
        if frame.rig is not self._rig:
            x_range_m, y_range_m = ground_map.x_range_m, ground_map.y_range_m
            of_map = replace(grid, rows=rows, columns=columns, x_range_m=x_range_m, y_range_m=y_range_m)
            points = apply(frame.rig.ego_from_bev, of_map.pillars()[::-1])  # (Y, X, Z, 3), the largest y first
            self._of_camera = {camera.name: np.any(camera.sees(points), axis=-1) for camera in frame.rig.cameras}
            self._rig = frame.rig
        seen = np.zeros((rows, columns), dtype=bool)
        for camera in frame.images:
            seen |= self._of_camera[camera]
        return replace(ground_map, cells=np.where(seen, ground_map.cells, 0))
