"""The segmentation loss: zero for the right answer, and each part against numbers worked out by hand."""

from __future__ import annotations

from math import log

import pytest
import torch
from torch import Tensor

from bevcli.model.segmentation import SegmentationOutputs
from bevcli.training.segmentation_loss import SegmentationLossConfig, segmentation_loss
from bevcli.training.segmentation_targets import SegmentationTargets

CONFIG = SegmentationLossConfig(class_weight=1.0, location_weight=2.0, dice_weight=3.0, pixel_weight=4.0)
LEFT, RIGHT, NOTHING = [1.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 1.0], [0.0] * 4


def outputs(masks: Tensor, classes: list[float], locations: list[list[float]]) -> SegmentationOutputs:
    """One layer, one frame; masks of 0 and 1 become sure logits."""
    return SegmentationOutputs(
        80 * (masks - 0.5)[None, None], 40 * (torch.tensor(classes) - 0.5)[None, None], torch.tensor([[locations]])
    )


RIGHT_ANSWER = outputs(
    torch.tensor([[1.0] * 4, NOTHING, LEFT, RIGHT, LEFT]),
    [1, 0, 1, 1, 1],
    [[0.75, 0.5, 0.5, 1.0], [0.25, 0.5, 0.5, 1.0]],
)
TRUTH = SegmentationTargets(
    stuff=torch.tensor([[1.0] * 4, NOTHING, LEFT]),
    things=torch.tensor([LEFT, RIGHT]),
    locations=torch.tensor([[0.25, 0.5, 0.5, 1.0], [0.75, 0.5, 0.5, 1.0]]),
)


def test_the_right_answer_costs_nothing_in_whatever_order_its_things_come() -> None:
    assert segmentation_loss(RIGHT_ANSWER, [TRUTH], CONFIG).total.item() == pytest.approx(0, abs=1e-4)


def test_a_moved_location_costs_its_distance() -> None:
    moved = SegmentationOutputs(
        RIGHT_ANSWER.mask_logits, RIGHT_ANSWER.class_logits, RIGHT_ANSWER.locations + torch.tensor([0.1, 0, 0, 0])
    )
    loss = segmentation_loss(moved, [TRUTH], CONFIG)
    assert loss.locations.item() == pytest.approx(2.0 * (2 * 0.1) / 2)  # two things in the frame
    assert loss.masks.item() == pytest.approx(0, abs=1e-4)


def test_an_undecided_mask_costs_dice_and_focal_loss() -> None:
    logits = RIGHT_ANSWER.mask_logits.clone()
    logits[0, 0, 2] = 0  # the crossing: 1/2 everywhere, of which two cells of four are right
    loss = segmentation_loss(
        SegmentationOutputs(logits, RIGHT_ANSWER.class_logits, RIGHT_ANSWER.locations), [TRUTH], CONFIG
    )
    dice = 1 - 2 * 1 / (4 * 0.25 + 2)
    pixels = (0.25 + 0.75) / 2 * 0.25 * log(2)
    assert loss.masks.item() == pytest.approx((3 * dice + 4 * pixels) / 2, rel=1e-3)  # two masks of stuff


def test_a_wrong_class_costs_focal_loss() -> None:
    logits = RIGHT_ANSWER.class_logits.clone()
    logits[0, 0, 1] = 0  # perhaps a lane boundary, where there is none
    loss = segmentation_loss(
        SegmentationOutputs(RIGHT_ANSWER.mask_logits, logits, RIGHT_ANSWER.locations), [TRUTH], CONFIG
    )
    assert loss.classes.item() == pytest.approx(0.75 / 4 * log(2) / 2, rel=1e-3)


def test_without_a_map_stuff_is_not_taught() -> None:
    unknown = SegmentationTargets(None, TRUTH.things, TRUTH.locations)
    wrong = outputs(
        torch.tensor([NOTHING, LEFT, RIGHT, RIGHT, LEFT]),
        [0, 1, 1, 1, 1],
        [[0.75, 0.5, 0.5, 1.0], [0.25, 0.5, 0.5, 1.0]],
    )
    assert segmentation_loss(wrong, [unknown], CONFIG).total.item() == pytest.approx(0, abs=1e-4)


def test_every_mask_layer_is_taught() -> None:
    logits = torch.cat([torch.zeros_like(RIGHT_ANSWER.mask_logits), RIGHT_ANSWER.mask_logits])
    two = SegmentationOutputs(logits, RIGHT_ANSWER.class_logits.expand(2, -1, -1), RIGHT_ANSWER.locations)
    assert segmentation_loss(two, [TRUTH], CONFIG).masks.item() > 0.5


def test_many_vehicles_do_not_drown_the_road() -> None:
    logits = RIGHT_ANSWER.mask_logits.clone()
    logits[0, 0, 0] = 0  # the road is undecided
    one_wrong = SegmentationOutputs(logits, RIGHT_ANSWER.class_logits, RIGHT_ANSWER.locations)
    without_things = SegmentationTargets(TRUTH.stuff, TRUTH.things[:0], TRUTH.locations[:0])
    with_things = segmentation_loss(one_wrong, [TRUTH], CONFIG).masks.item()
    assert with_things == pytest.approx(segmentation_loss(one_wrong, [without_things], CONFIG).masks.item(), abs=1e-4)
