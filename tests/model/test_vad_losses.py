"""The losses of VAD's lines, futures and paths against values computed by hand."""

from dataclasses import replace
from math import log, pi

import numpy as np
import pytest
import torch
from torch import Tensor

from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.boxes import Boxes3D
from bevcli.workshop.formats.map_lines import MapLines
from bevcli.workshop.vad.heads import LineDecoderConfig, LineOutputs, MotionOutputs
from bevcli.workshop.vad.losses import (
    FrameTruth,
    LineTargets,
    boundary_loss,
    collision_loss,
    crosses,
    direction_loss,
    line_losses,
    line_targets,
    motion_losses,
    path_losses,
)
from bevcli.workshop.vad.vad import LossWeights

GRID = BevGrid(4, 4, (-10, 10), (-20, 20), (-2, 2))
EXTENT_M = torch.tensor([20.0, 40.0])
WEIGHTS = LossWeights(line_class=2, line_points=3, line_direction=5, future=7, mode=11)
SQUARE = np.array([[-4.0, -4], [4, -4], [4, 4], [-4, 4], [-4, -4]])
SURE = 40.0  # a logit whose focal loss is nothing


def targets(*lines: tuple[str, np.ndarray], points: int = 5) -> LineTargets:
    names, places = [name for name, _ in lines], tuple(np.asarray(at, dtype=float) for _, at in lines)
    return line_targets(
        MapLines(places, np.array(names)), LineDecoderConfig(line_points=points), GRID, torch.device("cpu")
    )


def lines_found(points: Tensor, *classes: int | None) -> LineOutputs:
    """One layer, one frame. points: (N, P, 2) metres. classes: of each line; None for no line."""
    logits = torch.full((1, 1, len(classes), 3), -SURE)
    for line, index in enumerate(classes):
        if index is not None:
            logits[0, 0, line, index] = SURE
    shares = (points - torch.tensor([-10.0, -20.0])) / EXTENT_M
    return LineOutputs(logits, shares[None, None].float(), torch.zeros(0))


def test_a_line_can_be_told_in_both_directions() -> None:
    found = targets(("divider", [[0, -20], [0, 20]]), ("other", SQUARE), points=3)
    assert found.labels.tolist() == [0]
    assert found.orders.shape == (1, 4, 3, 2)
    orders = {tuple(order[:, 1].tolist()) for order in found.orders[0]}
    assert orders == {(0.0, 0.5, 1.0), (1.0, 0.5, 0.0)}
    assert (found.orders[..., 0] == 0.5).all()


def test_a_closed_line_starts_at_any_of_its_points() -> None:
    found = targets(("ped_crossing", SQUARE)).orders[0] * EXTENT_M - EXTENT_M / 2  # (8, 5, 2) metres
    assert torch.equal(found[:, 0], found[:, -1])
    corners = {tuple(corner) for corner in SQUARE.tolist()}
    assert {tuple(order[0].tolist()) for order in found} == corners
    assert len({tuple(order.flatten().tolist()) for order in found}) == 8
    assert (found.diff(dim=1).norm(dim=-1) - 8).abs().max() < 1e-5  # each order goes around once


def test_the_range_cuts_a_line_into_its_parts() -> None:
    found = targets(("boundary", [[-30, 0], [30, 0]]), ("divider", [[30, 0], [30, 5]]), points=2)
    assert found.labels.tolist() == [2]
    assert found.orders[0, 0].tolist() == [[0.0, 0.5], [1.0, 0.5]]


@pytest.mark.parametrize("start", range(4))
def test_a_perfect_line_has_no_loss_in_any_order(start: int) -> None:
    ring = np.roll(SQUARE[:-1], start, axis=0)
    square = torch.tensor(np.concatenate([ring, ring[:1]])).flip(0)
    losses = line_losses(
        lines_found(torch.stack([0 * square, square]), None, 1), [targets(("ped_crossing", SQUARE))], WEIGHTS, EXTENT_M
    )
    assert [loss.item() for loss in losses.values()] == pytest.approx([0, 0, 0], abs=1e-5)


def test_the_loss_of_a_line_is_that_of_its_points_and_angles() -> None:
    true = targets(("divider", [[0, -4], [0, 4]]), points=2)
    diagonal = torch.tensor([[[1.0, 3.0], [-1.0, 5.0]], [[9, 9], [9, 9]]])
    outputs = lines_found(diagonal, None, None)
    outputs.class_logits[0, 0, 0] = 0
    losses = line_losses(outputs, [true], WEIGHTS, EXTENT_M)
    # The points of the first are 1 m off in x, and 7 and 1 m in y; of the other direction, 1 and 9 m in y.
    assert losses["line points"].item() == pytest.approx(3 * (2 / 20 + 8 / 40))
    assert losses["line directions"].item() == pytest.approx(5 * (1 - 1 / 2**0.5))
    assert losses["line classes"].item() == pytest.approx(2 * (0.25 + 2 * 0.75) / 4 * log(2))


def test_a_frame_without_lines_teaches_that_there_is_none() -> None:
    outputs = lines_found(torch.zeros(2, 5, 2), None, None)
    outputs.class_logits[0, 0, 0, 0] = 0
    losses = line_losses(outputs, [targets()], WEIGHTS, EXTENT_M)
    assert [loss.item() for loss in losses.values()] == pytest.approx([2 * 0.75 / 4 * log(2), 0, 0])


def car(*places: tuple[float, float]) -> Boxes3D:
    """A car at (1, 1) with a future."""
    future = [[(0.5 * (step + 1), x, y) for step, (x, y) in enumerate(places)]]
    one = Boxes3D(np.ones((1, 3)), np.ones((1, 3)), np.zeros(1), np.zeros((1, 2)), np.array(["car"]))
    return replace(one, futures=np.array([future]))


def test_the_mode_that_ends_nearest_learns_the_future() -> None:
    offsets = torch.zeros(1, 2, 2, 2, 2)  # frame, queries, modes, steps, x and y
    offsets[0, 1] = torch.tensor([[[0.0, 9], [0, -6]], [[0, 1], [0, 1]]])  # they end at (1, 4) and (1, 3)
    outputs = MotionOutputs(offsets, torch.full((1, 2, 2), -SURE), torch.zeros(0))
    outputs.mode_logits[0, 1] = 0
    matches = [(torch.tensor([1]), torch.tensor([0]))]
    losses = motion_losses(outputs, [car((1, 2), (1, 4))], matches, WEIGHTS)
    assert losses["futures"].item() == pytest.approx(7 * (8 + 8))
    assert losses["modes"].item() == pytest.approx(11 * (0.25 + 0.75) / 4 * log(2))


def test_steps_without_a_true_place_are_not_learned() -> None:
    nan, matches = float("nan"), [(torch.tensor([0]), torch.tensor([0]))]
    offsets = torch.tensor([[[[[0.0, 1.5], [5.0, 5.0]], [[0.0, 3.0], [0.0, 0.0]]]]])
    outputs = MotionOutputs(offsets, torch.zeros(1, 1, 2), torch.zeros(0))
    losses = motion_losses(outputs, [car((1, 2), (nan, nan))], matches, WEIGHTS)
    assert losses["futures"].item() == pytest.approx(7 * 0.5)
    losses = motion_losses(outputs, [car((nan, nan), (nan, nan))], matches, WEIGHTS)
    assert [loss.item() for loss in losses.values()] == [0, 0]


def test_a_path_keeps_away_from_boundaries_until_it_crosses() -> None:
    wall = torch.tensor([[[2.0, float(y)] for y in range(5)], [[-50.0, float(y)] for y in range(5)]])
    path = torch.tensor([[0.0, 1.0], [1.4, 2.0], [1.7, 3.0], [2.5, 4.0], [1.8, 4.0]])
    assert boundary_loss(path, wall).tolist() == pytest.approx([0, 0.4, 0.7, 0, 0])
    assert boundary_loss(path, wall[:0]).tolist() == [0] * 5


def test_two_segments_cross_or_not() -> None:
    start, end = torch.tensor([[0.0, 0.0]] * 3), torch.tensor([[2.0, 2.0]] * 3)
    lines = torch.tensor([[[0.0, 2], [2, 0]], [[3, 0], [3, 9]], [[1, 0], [3, 2]]])  # the last is parallel
    assert crosses(start, end, lines).tolist() == [True, False, False]


def test_a_path_keeps_away_from_vehicles_nearby() -> None:
    path = torch.tensor([[0.0, 0.0], [0.0, 2.0]])
    others = torch.tensor([[[1.0, 2.0], [0.5, 9.0]], [[-1.2, -0.5], [0.0, 6.0]]])
    # At first both are near: 1 and 1.2 m across, 2 and 0.5 m along. Then none is.
    assert collision_loss(path, others).flatten().tolist() == pytest.approx([0.5, 2.5, 0, 0])
    assert collision_loss(path, others[:0]).tolist() == [[0, 0], [0, 0]]


def test_a_path_is_along_the_divider_beside_it() -> None:
    path = torch.tensor([[0.0, 0.0], [1.0, 1.0], [1.0, 2.0], [6.0, 2.0]])
    divider = torch.tensor([[[-1.0, y] for y in (4.0, 2.0, 0.0, -2.0)]])
    assert direction_loss(path, divider).tolist() == pytest.approx([pi / 4, 0, pi / 2, 0])
    assert direction_loss(path / 9, divider).tolist() == [0] * 4  # it stands


def test_the_loss_of_a_path_is_the_mean_over_known_steps() -> None:
    driven = np.array([[1.0, 2.0], [1.0, 5.0], [np.nan, np.nan]])
    truth = FrameTruth(Boxes3D.empty(), MapLines((), np.zeros(0, dtype=np.str_)), driven, "straight")
    nothing = [torch.zeros(0, 3, 2)] * 3
    offsets = torch.tensor([[1.0, 2.0], [0.5, 4.0], [9.0, 9.0]])
    assert path_losses(offsets, truth, *nothing).tolist() == pytest.approx([(0.5 + 1) / 2 / 3, 0, 0, 0])
