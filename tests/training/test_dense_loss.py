"""The dense loss: cells near an object are positives of its class and its box."""

from __future__ import annotations

import pytest
import torch

from bevcli.geometry.bev_grid import BevGrid
from bevcli.workshop.training.losses import DenseHead, DenseLossConfig, DetectionLossConfig, dense_loss
from bevcli.workshop.training.targets import DetectionTargets

GRID = BevGrid(4, 4, (-4, 4), (-4, 4), (-3, 3), 4)  # cells of 2 m, centres at ±1 and ±3


def code(x: float, y: float) -> list[float]:
    return [x, y, 0, 0, 0, 0, 0, 0, 0, 0]


def zero_head() -> DenseHead:
    head = DenseHead(2, 3, GRID)
    for parameter in head.parameters():
        torch.nn.init.zeros_(parameter)
    return head


def test_cells_in_reach_are_positives_of_the_nearest_object() -> None:
    truth = DetectionTargets(torch.tensor([2, 0]), torch.tensor([code(1, 1), code(1.5, 3)]))
    config, weights = DenseLossConfig(weight=2.0, reach_m=1.0), DetectionLossConfig(box_weight=0.5)
    loss = dense_loss(zero_head(), torch.zeros(1, 16, 2), [truth], config, weights)
    # Two cells are positives: (1, 1) without an error, (1, 3) with half a metre.
    assert loss["cell boxes"].item() == pytest.approx(2.0 * 0.5 * 0.5 / 2)


def test_a_frame_without_objects_has_negatives_only() -> None:
    nothing = DetectionTargets(torch.zeros(0, dtype=torch.int64), torch.zeros(0, 10))
    loss = dense_loss(zero_head(), torch.zeros(1, 16, 2), [nothing], DenseLossConfig(1.0), DetectionLossConfig())
    assert loss["cell boxes"].item() == 0
    assert loss["cell classes"].item() > 0
