"""The dense loss: the cells near an object say its class and its box."""

from __future__ import annotations

import pytest
import torch

from bevcli.geometry.bev_grid import BevGrid
from bevcli.training.dense_loss import DenseHead, DenseLossConfig, dense_loss
from bevcli.training.detection_loss import DetectionLossConfig
from bevcli.training.detection_targets import DetectionTargets

GRID = BevGrid(4, 4, (-4, 4), (-4, 4), (-3, 3), 4)  # cells of 2 m, centres at ±1 and ±3


def code(x: float, y: float) -> list[float]:
    return [x, y, 0, 0, 0, 0, 0, 0, 0, 0]


def reader_that_says_nothing() -> DenseHead:
    reader = DenseHead(2, 3, GRID)
    for parameter in reader.parameters():
        torch.nn.init.zeros_(parameter)
    return reader


def test_the_cells_in_reach_answer_for_the_nearest_object() -> None:
    truth = DetectionTargets(torch.tensor([2, 0]), torch.tensor([code(1, 1), code(1.5, 3)]))
    config, of_boxes = DenseLossConfig(weight=2.0, reach_m=1.0), DetectionLossConfig(box_weight=0.5)
    loss = dense_loss(reader_that_says_nothing(), torch.zeros(1, 16, 2), [truth], config, of_boxes)
    # Two cells are taught: that at (1, 1) without an error, that at (1, 3) half a metre off.
    assert loss.boxes.item() == pytest.approx(2.0 * 0.5 * 0.5 / 2)


def test_a_frame_without_objects_teaches_that_there_are_none() -> None:
    nothing = DetectionTargets(torch.zeros(0, dtype=torch.int64), torch.zeros(0, 10))
    loss = dense_loss(
        reader_that_says_nothing(), torch.zeros(1, 16, 2), [nothing], DenseLossConfig(1.0), DetectionLossConfig()
    )
    assert loss.boxes.item() == 0
    assert loss.classes.item() > 0
