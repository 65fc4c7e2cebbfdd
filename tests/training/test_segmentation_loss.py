"""The segmentation loss: zero for a perfect output, and each part against values computed by hand."""

from __future__ import annotations

from math import log

import pytest
import torch
from torch import Tensor

from bevcli.model.segmentation import SegmentationOutputs
from bevcli.workshop.training.losses import SegmentationLossConfig, segmentation_loss
from bevcli.workshop.training.targets import SegmentationTargets

CONFIG = SegmentationLossConfig(class_weight=1.0, location_weight=2.0, dice_weight=3.0, pixel_weight=4.0)
LEFT, RIGHT, NOTHING = [1.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 1.0], [0.0] * 4


def outputs(masks: Tensor, classes: list[float], locations: list[list[float]]) -> SegmentationOutputs:
    """One layer, one frame; masks of 0 and 1 become logits of large magnitude."""
    return SegmentationOutputs(
        80 * (masks - 0.5)[None, None], 40 * (torch.tensor(classes) - 0.5)[None, None], torch.tensor([[locations]])
    )


PERFECT = outputs(
    torch.tensor([[1.0] * 4, NOTHING, LEFT, RIGHT, LEFT]),
    [1, 0, 1, 1, 1],
    [[0.75, 0.5, 0.5, 1.0], [0.25, 0.5, 0.5, 1.0]],
)
TRUTH = SegmentationTargets(
    stuff=torch.tensor([[1.0] * 4, NOTHING, LEFT]),
    things=torch.tensor([LEFT, RIGHT]),
    locations=torch.tensor([[0.25, 0.5, 0.5, 1.0], [0.75, 0.5, 0.5, 1.0]]),
)


def total(losses: dict[str, Tensor]) -> float:
    return sum(losses.values()).item()


def test_a_perfect_output_has_no_loss_in_any_order_of_its_things() -> None:
    assert total(segmentation_loss(PERFECT, [TRUTH], CONFIG)) == pytest.approx(0, abs=1e-4)


def test_the_location_loss_is_the_distance() -> None:
    moved = SegmentationOutputs(
        PERFECT.mask_logits, PERFECT.class_logits, PERFECT.locations + torch.tensor([0.1, 0, 0, 0])
    )
    loss = segmentation_loss(moved, [TRUTH], CONFIG)
    assert loss["locations"].item() == pytest.approx(2.0 * (2 * 0.1) / 2)  # two things in the frame
    assert loss["masks"].item() == pytest.approx(0, abs=1e-4)


def test_an_undecided_mask_has_dice_and_focal_loss() -> None:
    logits = PERFECT.mask_logits.clone()
    logits[0, 0, 2] = 0  # the crossing: probability 1/2 in all four cells, two of which are crossing
    loss = segmentation_loss(SegmentationOutputs(logits, PERFECT.class_logits, PERFECT.locations), [TRUTH], CONFIG)
    dice = 1 - 2 * 1 / (4 * 0.25 + 2)
    pixels = (0.25 + 0.75) / 2 * 0.25 * log(2)
    assert loss["masks"].item() == pytest.approx((3 * dice + 4 * pixels) / 2, rel=1e-3)  # two masks of stuff


def test_a_wrong_class_has_focal_loss() -> None:
    logits = PERFECT.class_logits.clone()
    logits[0, 0, 1] = 0  # lane boundary with probability 1/2, where there is none
    loss = segmentation_loss(SegmentationOutputs(PERFECT.mask_logits, logits, PERFECT.locations), [TRUTH], CONFIG)
    assert loss["map classes"].item() == pytest.approx(0.75 / 4 * log(2) / 2, rel=1e-3)


def test_a_frame_without_a_map_has_no_stuff_loss() -> None:
    unknown = SegmentationTargets(None, TRUTH.things, TRUTH.locations)
    wrong = outputs(
        torch.tensor([NOTHING, LEFT, RIGHT, RIGHT, LEFT]),
        [0, 1, 1, 1, 1],
        [[0.75, 0.5, 0.5, 1.0], [0.25, 0.5, 0.5, 1.0]],
    )
    assert total(segmentation_loss(wrong, [unknown], CONFIG)) == pytest.approx(0, abs=1e-4)


def test_every_mask_layer_has_a_loss() -> None:
    logits = torch.cat([torch.zeros_like(PERFECT.mask_logits), PERFECT.mask_logits])
    two = SegmentationOutputs(logits, PERFECT.class_logits.expand(2, -1, -1), PERFECT.locations)
    assert segmentation_loss(two, [TRUTH], CONFIG)["masks"].item() > 0.5


def test_vehicles_do_not_lower_the_weight_of_the_road() -> None:
    logits = PERFECT.mask_logits.clone()
    logits[0, 0, 0] = 0  # the road is undecided
    one_wrong = SegmentationOutputs(logits, PERFECT.class_logits, PERFECT.locations)
    without_things = SegmentationTargets(TRUTH.stuff, TRUTH.things[:0], TRUTH.locations[:0])
    with_things = segmentation_loss(one_wrong, [TRUTH], CONFIG)["masks"].item()
    assert with_things == pytest.approx(
        segmentation_loss(one_wrong, [without_things], CONFIG)["masks"].item(), abs=1e-4
    )
