"""Ground truth boxes as targets of the detection head."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bevcli.geometry.boxes import Boxes3D
from bevcli.model.bevformer import BEVFormerConfig
from bevcli.model.box_coding import encode


@dataclass(frozen=True)
class DetectionTargets:
    """The G ground truth boxes of one frame.

    Attributes:
        labels: (G,) int64, indices into the model's classes.
        codes: (G, 10) float32 box codes (see `bevcli.model.box_coding`); unknown velocities are NaN.
    """

    labels: Tensor
    codes: Tensor

    def to(self, device: torch.device) -> DetectionTargets:
        """A copy on a device."""
        return DetectionTargets(self.labels.to(device), self.codes.to(device))


def detection_targets(boxes: Boxes3D, config: BEVFormerConfig) -> DetectionTargets:
    """Targets from the boxes that have one of the model's classes, a centre inside the BEV grid, and visible points.

    Args:
        boxes: ground truth in the bev frame.
    """
    return box_targets(boxes[in_range(boxes, config)], config.classes)


def box_targets(boxes: Boxes3D, classes: tuple[str, ...]) -> DetectionTargets:
    """Targets from all boxes that have one of the classes and visible points.

    Args:
        boxes: ground truth in the bev frame.
    """
    kept = boxes[np.isin(boxes.classes, classes) & has_points(boxes)]
    labels = [classes.index(name) for name in kept.classes]
    return DetectionTargets(torch.tensor(labels, dtype=torch.int64), torch.from_numpy(encode(kept)).float())


def has_points(boxes: Boxes3D) -> NDArray[np.bool_]:
    """(N,) bool, false where the ground truth counts 0 points; boxes without a count are kept."""
    return np.ones(len(boxes), dtype=bool) if boxes.num_points is None else boxes.num_points != 0


def in_range(boxes: Boxes3D, config: BEVFormerConfig) -> NDArray[np.bool_]:
    """(N,) bool: whether the centre (bev frame) lies in the model's x, y and z range."""
    grid = config.bev_grid
    low, high = np.array([grid.x_range_m, grid.y_range_m, grid.z_range_m]).T
    return ((boxes.centers >= low) & (boxes.centers <= high)).all(-1)
