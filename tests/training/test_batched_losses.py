"""The losses of a batch are those of its frames, weighted by their numbers of objects: values and gradients."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import pytest
import torch
from torch import Tensor

from bevcli.geometry.bev_grid import BevGrid
from bevcli.model.segmentation import SegmentationOutputs
from bevcli.workshop.training.losses import (
    DenseHead,
    DenseLossConfig,
    DetectionLossConfig,
    SegmentationLossConfig,
    dense_loss,
    detection_loss,
    segmentation_loss,
)
from bevcli.workshop.training.targets import DetectionTargets, SegmentationTargets, padded, padded_masks

COUNTS = (1, 5, 2)  # objects of the frames; a batch is padded to 5
RANDOM = torch.Generator().manual_seed(0)


def drawn(*shape: int) -> Tensor:
    return torch.randn(*shape, generator=RANDOM)


def truths() -> list[DetectionTargets]:
    return [DetectionTargets(torch.randint(4, (count,), generator=RANDOM), drawn(count, 10)) for count in COUNTS]


def assert_mean_of_frames(
    loss: Callable[[slice], Mapping[str, Tensor]], leaves: list[Tensor], counts: Sequence[int] = COUNTS
) -> None:
    """Each loss of the batch is the mean of those of its frames, weighted by these counts; so are the gradients.

    loss: of some of the frames.
    """
    frames = [loss(slice(b, b + 1)) for b in range(len(counts))]
    for name, value in loss(slice(None)).items():
        expected = torch.stack([one[name] * count for one, count in zip(frames, counts, strict=True)]).sum() / sum(
            counts
        )
        torch.testing.assert_close(value, expected, rtol=1e-5, atol=1e-6)
        gradients = (
            torch.autograd.grad(one, leaves, retain_graph=True, materialize_grads=True) for one in (value, expected)
        )
        for found, apart in zip(*gradients, strict=True):
            torch.testing.assert_close(found, apart, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("quality_m", [0.0, 2.0])
def test_the_detection_loss_of_a_batch_is_that_of_its_frames(quality_m: float) -> None:
    logits, codes, truth = drawn(2, 3, 24, 4).requires_grad_(), drawn(2, 3, 24, 10).requires_grad_(), truths()
    config = DetectionLossConfig(moving_weight=5.0, quality_m=quality_m)
    assert_mean_of_frames(
        lambda part: detection_loss(logits[:, part], codes[:, part], padded(truth[part]), config, 3), [logits, codes]
    )


def test_the_dense_loss_of_a_batch_is_that_of_its_frames() -> None:
    grid = BevGrid(16, 16, (-8, 8), (-8, 8), (-3, 3), 4)
    head, truth, bev = DenseHead(8, 4, grid), truths(), drawn(3, 256, 8).requires_grad_()
    cells = torch.from_numpy(grid.cell_centers()).reshape(-1, 2)
    near = [(cells[:, None] - one.codes[:, :2]).norm(dim=-1).min(1).values <= 1.5 for one in truth]
    assert_mean_of_frames(
        lambda part: dense_loss(head, bev[part], padded(truth[part]), DenseLossConfig(1.0, 1.5), DetectionLossConfig()),
        [bev],
        [int(cells.sum()) for cells in near],
    )


@pytest.mark.parametrize(("counts", "with_map"), [(COUNTS, False), ((2, 2, 2), True)])
def test_the_map_losses_of_a_batch_are_those_of_its_frames(counts: tuple[int, ...], with_map: bool) -> None:
    """Stuff and things are divided by numbers of their own: with maps, all frames have as many of both."""
    truth = [
        SegmentationTargets(
            (drawn(3, 36) > 0).float() if with_map else None, (drawn(n, 36) > 0.5).float(), drawn(n, 4).sigmoid()
        )
        for n in counts
    ]
    masks, classes = drawn(2, 3, 11, 36).requires_grad_(), drawn(2, 3, 11).requires_grad_()
    places = drawn(2, 3, 8, 4).sigmoid().requires_grad_()

    def loss(part: slice) -> Mapping[str, Tensor]:
        outputs = SegmentationOutputs(masks[:, part], classes[:, part], places[:, part])
        return segmentation_loss(outputs, padded_masks(truth[part]), SegmentationLossConfig())

    assert_mean_of_frames(loss, [masks, classes, places], counts)
