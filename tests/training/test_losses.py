"""Losses against values computed by hand, and the Hungarian matching against every permutation.

The losses of a batch are those of its frames, weighted by their numbers of objects: values and gradients.
"""

from collections.abc import Callable, Mapping, Sequence
from itertools import permutations
from math import exp, log

import numpy as np
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
    dice_costs,
    dice_loss,
    focal_cost,
    focal_loss,
    hungarian_matchings,
    segmentation_loss,
)
from bevcli.workshop.training.targets import PaddedMasks, PaddedTargets, of_all


def pairs(costs: torch.Tensor, truths: int | None = None) -> tuple[list[int], list[int]]:
    """The queries that are matched, and the ground truth of each. truths: how many are no padding."""
    count = costs.shape[1] if truths is None else truths
    of_queries, of_truths = (matches[0].tolist() for matches in hungarian_matchings(costs[None], [count]))
    queries = [query for query, truth in enumerate(of_queries) if truth >= 0]
    assert sorted(queries) == sorted(query for query in of_truths if query >= 0)
    return queries, [of_queries[query] for query in queries]


@pytest.mark.parametrize("shape", [(5, 3), (3, 5), (4, 4), (6, 1)])
def test_no_permutation_is_cheaper_than_the_matching(shape: tuple[int, int]) -> None:
    costs = np.random.default_rng(sum(shape)).normal(size=shape)
    queries, truths = pairs(torch.from_numpy(costs))
    small, large = sorted(shape)
    wide = costs if shape[0] == small else costs.T
    cheapest = min(sum(wide[i, p] for i, p in enumerate(order)) for order in permutations(range(large), small))
    assert costs[queries, truths].sum() == pytest.approx(cheapest)
    assert len(set(queries)) == len(set(truths)) == small


def test_a_pair_with_a_nan_cost_is_chosen_last() -> None:
    assert pairs(torch.tensor([[float("nan"), 0.0], [1.0, 5.0]])) == ([0, 1], [1, 0])
    assert pairs(torch.zeros(4, 1), 0) == ([], [])  # without ground truth there are none


def test_focal_loss_by_hand() -> None:
    # logit log 3: p = 3/4. As a positive 0.25 · (1/4)² · -log(3/4), as a negative 0.75 · (3/4)² · -log(1/4).
    losses = focal_loss(torch.tensor([log(3), log(3)]), torch.tensor([1.0, 0.0]))
    assert losses.tolist() == pytest.approx([0.25 / 16 * log(4 / 3), 0.75 * 9 / 16 * log(4)])
    assert focal_cost(torch.tensor([log(3)])).tolist() == pytest.approx([0.25 / 16 * log(4 / 3) - 27 / 64 * log(4)])


def test_dice_loss_by_hand() -> None:
    logits = torch.tensor([[0.0, 0.0], [60.0, -60.0]])  # masks (1/2, 1/2) and (1, 0)
    truth = torch.tensor([1.0, 0.0])
    assert dice_loss(logits, truth.expand(2, 2)).tolist() == pytest.approx([1 - 1 / 1.5, 0], abs=1e-3)
    others = torch.tensor([[1.0, 0.0], [0.0, 1.0]])
    assert dice_costs(logits, others).flatten().tolist() == pytest.approx([1 / 3, 1 / 3, 0, 1], abs=1e-3)


def code(x: float, vx: float = 0.0) -> list[float]:
    return [x, 0, 0, 0, 0, 0, 0, 1, vx, 0]


def targets(*codes: list[float], label: int = 0) -> PaddedTargets:
    return PaddedTargets.of_frame(torch.full((len(codes),), label), torch.tensor(codes).reshape(len(codes), 10))


CONFIG = DetectionLossConfig()


def total(losses: dict[str, torch.Tensor]) -> float:
    return sum(losses.values()).item()


def test_detection_loss_by_hand() -> None:
    """Two queries, one class, one box: the nearer query is matched to it, the other is background."""
    codes = torch.tensor([[code(x=5.0), code(x=1.5, vx=3.0)]])[None]  # (1, 1, 2, 10)
    logits = torch.zeros(1, 1, 2, 1)  # p = 1/2 each
    loss = detection_loss(logits, codes, targets(code(x=1.0)), CONFIG)
    assert loss["boxes"].item() == pytest.approx(0.25 * (0.5 + 0.2 * 3.0))
    assert loss["classes"].item() == pytest.approx(2 * (0.25 + 0.75) / 4 * log(2))
    loss = detection_loss(torch.zeros(1, 1, 3, 2), torch.zeros(1, 1, 3, 10), targets(), CONFIG)
    assert loss["boxes"].item() == 0  # without boxes every query is background
    assert loss["classes"].item() == pytest.approx(2 * 6 * 0.75 / 4 * log(2))


def test_query_groups_are_matched_independently() -> None:
    random = torch.Generator().manual_seed(0)
    logits, codes = (torch.randn(2, 1, 6, size, generator=random) for size in (3, 10))
    truth = targets(code(x=1.0), code(x=-2.0), label=1)
    together = total(detection_loss(logits, codes, truth, CONFIG, groups=2))
    halves = zip(logits.chunk(2, dim=2), codes.chunk(2, dim=2), strict=True)
    apart = [total(detection_loss(*half, truth, CONFIG)) for half in halves]
    assert together == pytest.approx(sum(apart) / 2)


def test_of_two_queries_at_a_position_the_confident_is_matched() -> None:
    codes = torch.tensor([[code(0.0), code(0.0)]])[None]
    logits = torch.tensor([[[[-2.0], [2.0]]]])
    loss = detection_loss(logits, codes, targets(code(0.0)), CONFIG)["classes"].item()
    p = 1 / (1 + exp(-2))
    positive, negative = 0.25 * (1 - p) ** 2 * -log(p), 0.75 * (1 - p) ** 2 * -log(p)
    assert loss == pytest.approx(2 * (positive + negative), rel=1e-4)


def test_every_layer_adds_its_loss() -> None:
    codes, logits = torch.tensor([[code(2.0)]])[None], torch.zeros(1, 1, 1, 1)
    once = detection_loss(logits, codes, targets(code(0.0)), CONFIG)
    thrice = detection_loss(logits.expand(3, -1, -1, -1), codes.expand(3, -1, -1, -1), targets(code(0.0)), CONFIG)
    assert total(thrice) == pytest.approx(3 * total(once))


def test_a_box_of_unknown_velocity_adds_to_the_class_loss_only() -> None:
    codes, logits = torch.tensor([[code(2.0)]])[None], torch.zeros(1, 1, 1, 1)
    loss = detection_loss(logits, codes, targets(code(0.0, vx=float("nan"))), CONFIG)
    assert loss["boxes"].item() == 0
    assert loss["classes"].item() == pytest.approx(2 * 0.25 / 4 * log(2))


@pytest.mark.parametrize(("true_speed", "weight"), [(0.4, 1.0), (4.0, 5.0)])
def test_velocities_of_moving_objects_can_have_a_higher_weight(true_speed: float, weight: float) -> None:
    codes, logits = torch.tensor([[code(0.0)]])[None], torch.zeros(1, 1, 1, 1)
    config = DetectionLossConfig(velocity_weight=0.5, moving_weight=5.0)
    loss = detection_loss(logits, codes, targets(code(0.0, vx=true_speed)), config)
    assert loss["boxes"].item() == pytest.approx(0.25 * 0.5 * weight * true_speed)


def test_the_class_target_can_fall_with_the_distance() -> None:
    codes, config = torch.tensor([[code(3.0)]])[None], DetectionLossConfig(quality_m=2.0)

    def class_loss(score: float) -> float:
        logits = torch.full((1, 1, 1, 1), log(score / (1 - score)))
        return detection_loss(logits, codes, targets(code(1.0)), config)["classes"].item()

    best = exp(-1)  # 2 m from the true centre
    assert class_loss(best) == pytest.approx(0, abs=1e-6)
    assert class_loss(best - 0.1) > 1e-3 < class_loss(best + 0.1)


GRID = BevGrid(4, 4, (-4, 4), (-4, 4), (-3, 3), 4)  # cells of 2 m, centres at ±1 and ±3


def at(x: float, y: float) -> list[float]:
    return [x, y, 0, 0, 0, 0, 0, 0, 0, 0]


def zero_head() -> DenseHead:
    head = DenseHead(2, 3, GRID)
    for parameter in head.parameters():
        torch.nn.init.zeros_(parameter)
    return head


def test_cells_in_reach_are_positives_of_the_nearest_object() -> None:
    truth = PaddedTargets.of_frame(torch.tensor([2, 0]), torch.tensor([at(1, 1), at(1.5, 3)]))
    config, weights = DenseLossConfig(weight=2.0, reach_m=1.0), DetectionLossConfig(box_weight=0.5)
    loss = dense_loss(zero_head(), torch.zeros(1, 16, 2), truth, config, weights)
    # Two cells are positives: (1, 1) without an error, (1, 3) with half a metre.
    assert loss["cell boxes"].item() == pytest.approx(2.0 * 0.5 * 0.5 / 2)
    loss = dense_loss(zero_head(), torch.zeros(1, 16, 2), targets(), DenseLossConfig(1.0), DetectionLossConfig())
    assert loss["cell boxes"].item() == 0  # of a frame without objects
    assert loss["cell classes"].item() > 0


COUNTS = (1, 5, 2)  # objects of the frames; a batch is padded to 5
RANDOM = torch.Generator().manual_seed(0)


def drawn(*shape: int) -> Tensor:
    return torch.randn(*shape, generator=RANDOM)


def truths() -> list[PaddedTargets]:
    return [PaddedTargets.of_frame(torch.randint(4, (count,), generator=RANDOM), drawn(count, 10)) for count in COUNTS]


def assert_mean_of_frames(
    loss: Callable[[slice], Mapping[str, Tensor]], leaves: list[Tensor], counts: Sequence[int] = COUNTS
) -> None:
    """Each loss of the batch is the mean of those of its frames, weighted by these counts; so are the gradients.

    loss: of some of the frames.
    """
    frames = [loss(slice(b, b + 1)) for b in range(len(counts))]
    for name, value in loss(slice(None)).items():
        weighted = [one[name] * count for one, count in zip(frames, counts, strict=True)]
        expected = torch.stack(weighted).sum() / sum(counts)
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
        lambda part: detection_loss(logits[:, part], codes[:, part], of_all(truth[part]), config, 3), [logits, codes]
    )


def test_the_dense_loss_of_a_batch_is_that_of_its_frames() -> None:
    grid = BevGrid(16, 16, (-8, 8), (-8, 8), (-3, 3), 4)
    head, truth, bev = DenseHead(8, 4, grid), truths(), drawn(3, 256, 8).requires_grad_()
    cells = torch.from_numpy(grid.cell_centers()).reshape(-1, 2)
    near = [(cells[:, None] - one.codes[0, :, :2]).norm(dim=-1).min(1).values <= 1.5 for one in truth]
    assert_mean_of_frames(
        lambda part: dense_loss(head, bev[part], of_all(truth[part]), DenseLossConfig(1.0, 1.5), DetectionLossConfig()),
        [bev],
        [int(cells.sum()) for cells in near],
    )


@pytest.mark.parametrize(("counts", "with_map"), [(COUNTS, False), ((2, 2, 2), True)])
def test_the_map_losses_of_a_batch_are_those_of_its_frames(counts: tuple[int, ...], with_map: bool) -> None:
    """Stuff and things are divided by numbers of their own: with maps, all frames have as many of both."""
    truth = [
        PaddedMasks.of_frame(
            (drawn(3, 36) > 0).float() if with_map else None, (drawn(n, 36) > 0.5).float(), drawn(n, 4).sigmoid()
        )
        for n in counts
    ]
    masks, classes = drawn(2, 3, 11, 36).requires_grad_(), drawn(2, 3, 11).requires_grad_()
    places = drawn(2, 3, 8, 4).sigmoid().requires_grad_()

    def loss(part: slice) -> Mapping[str, Tensor]:
        outputs = SegmentationOutputs(masks[:, part], classes[:, part], places[:, part])
        return segmentation_loss(outputs, of_all(truth[part]), SegmentationLossConfig())

    assert_mean_of_frames(loss, [masks, classes, places], counts)


MAP_WEIGHTS = SegmentationLossConfig(class_weight=1.0, location_weight=2.0, dice_weight=3.0, pixel_weight=4.0)
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
TRUTH = PaddedMasks.of_frame(
    stuff=torch.tensor([[1.0] * 4, NOTHING, LEFT]),
    things=torch.tensor([LEFT, RIGHT]),
    locations=torch.tensor([[0.25, 0.5, 0.5, 1.0], [0.75, 0.5, 0.5, 1.0]]),
)


def test_a_perfect_output_has_no_loss_in_any_order_of_its_things() -> None:
    assert total(segmentation_loss(PERFECT, TRUTH, MAP_WEIGHTS)) == pytest.approx(0, abs=1e-4)
    logits = torch.cat([torch.zeros_like(PERFECT.mask_logits), PERFECT.mask_logits])
    two = SegmentationOutputs(logits, PERFECT.class_logits.expand(2, -1, -1), PERFECT.locations)
    assert segmentation_loss(two, TRUTH, MAP_WEIGHTS)["masks"].item() > 0.5  # every layer of masks has a loss


def test_the_location_loss_is_the_distance() -> None:
    moved = SegmentationOutputs(
        PERFECT.mask_logits, PERFECT.class_logits, PERFECT.locations + torch.tensor([0.1, 0, 0, 0])
    )
    loss = segmentation_loss(moved, TRUTH, MAP_WEIGHTS)
    assert loss["locations"].item() == pytest.approx(2.0 * (2 * 0.1) / 2)  # two things in the frame
    assert loss["masks"].item() == pytest.approx(0, abs=1e-4)


def test_an_undecided_mask_has_dice_and_focal_loss() -> None:
    logits = PERFECT.mask_logits.clone()
    logits[0, 0, 2] = 0  # the crossing: probability 1/2 in all four cells, two of which are crossing
    loss = segmentation_loss(SegmentationOutputs(logits, PERFECT.class_logits, PERFECT.locations), TRUTH, MAP_WEIGHTS)
    dice = 1 - 2 * 1 / (4 * 0.25 + 2)
    pixels = (0.25 + 0.75) / 2 * 0.25 * log(2)
    assert loss["masks"].item() == pytest.approx((3 * dice + 4 * pixels) / 2, rel=1e-3)  # two masks of stuff


def test_a_wrong_class_has_focal_loss() -> None:
    logits = PERFECT.class_logits.clone()
    logits[0, 0, 1] = 0  # lane boundary with probability 1/2, where there is none
    loss = segmentation_loss(SegmentationOutputs(PERFECT.mask_logits, logits, PERFECT.locations), TRUTH, MAP_WEIGHTS)
    assert loss["map classes"].item() == pytest.approx(0.75 / 4 * log(2) / 2, rel=1e-3)


def test_a_frame_without_a_map_has_no_stuff_loss() -> None:
    unknown = PaddedMasks.of_frame(None, TRUTH.things[0], TRUTH.locations[0])
    wrong = outputs(
        torch.tensor([NOTHING, LEFT, RIGHT, RIGHT, LEFT]),
        [0, 1, 1, 1, 1],
        [[0.75, 0.5, 0.5, 1.0], [0.25, 0.5, 0.5, 1.0]],
    )
    assert total(segmentation_loss(wrong, unknown, MAP_WEIGHTS)) == pytest.approx(0, abs=1e-4)


def test_vehicles_do_not_lower_the_weight_of_the_road() -> None:
    logits = PERFECT.mask_logits.clone()
    logits[0, 0, 0] = 0  # the road is undecided
    one_wrong = SegmentationOutputs(logits, PERFECT.class_logits, PERFECT.locations)
    without_things = PaddedMasks.of_frame(TRUTH.stuff[0], TRUTH.things[0, :0], TRUTH.locations[0, :0])
    both = [segmentation_loss(one_wrong, each, MAP_WEIGHTS)["masks"].item() for each in (TRUTH, without_things)]
    assert both[0] == pytest.approx(both[1], abs=1e-4)
