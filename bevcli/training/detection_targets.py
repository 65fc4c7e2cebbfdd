"""What the detection head should say of a frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from bevcli.geometry.boxes import Boxes3D
from bevcli.model.bevformer import BEVFormerConfig
from bevcli.model.box_coding import encode


@dataclass(frozen=True)
class DetectionTargets:
    """labels: (G,) int64, places in the model's classes. codes: (G, 10) float32, NaN velocities where unknown."""

    labels: Tensor
    codes: Tensor

    def to(self, device: torch.device) -> DetectionTargets:
        """The same on a device."""
        return DetectionTargets(self.labels.to(device), self.codes.to(device))


def detection_targets(boxes: Boxes3D, config: BEVFormerConfig) -> DetectionTargets:
    """Ground truth (bev frame) that the model can learn: of its classes, centre in range, seen at all."""
    chosen = boxes[np.isin(boxes.classes, config.classes) & in_range(boxes, config) & seen(boxes)]
    labels = [config.classes.index(name) for name in chosen.classes]
    return DetectionTargets(torch.tensor(labels, dtype=torch.int64), torch.from_numpy(encode(chosen)).float())


def seen(boxes: Boxes3D) -> np.ndarray:
    """(N,) bool: not stated to be without a single point."""
    return np.ones(len(boxes), dtype=bool) if boxes.num_points is None else boxes.num_points != 0


def in_range(boxes: Boxes3D, config: BEVFormerConfig) -> np.ndarray:
    """(N,) bool: the centre lies in the model's range; boxes in the bev frame."""
    grid = config.bev_grid
    low, high = np.array([grid.x_range_m, grid.y_range_m, grid.z_range_m]).T
    return ((boxes.centers >= low) & (boxes.centers <= high)).all(-1)
