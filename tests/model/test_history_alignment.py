"""Rotation of the history map: compared with numpy's quarter turns, and about the configured centre."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from bevcli.geometry.bev_grid import BevGrid
from bevcli.model.ego_motion import rotate_history

SQUARE = BevGrid(6, 6)


def turn(history: np.ndarray, degrees: float, center: object = "center", grid: BevGrid = SQUARE) -> np.ndarray:
    """history: (Y, X, C) -> (Y, X, C)."""
    flat = torch.from_numpy(history).flatten(0, 1)[None]
    return rotate_history(flat, torch.tensor([degrees]), grid, center)[0].numpy().reshape(history.shape)  # type: ignore[arg-type]


def random_map(rows: int, columns: int) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(rows, columns, 3))


@pytest.mark.parametrize("quarters", [0, 1, 2, 3, -1])
def test_quarter_turns_are_those_of_numpy(quarters: int) -> None:
    history = random_map(6, 6)
    # Row indices grow ahead of the vehicle, so that its left turn is a rotation in numpy's direction.
    np.testing.assert_array_equal(turn(history, 90.0 * quarters), np.rot90(history, quarters))


def test_angles_a_full_circle_apart_are_the_same() -> None:
    history = random_map(6, 6)
    np.testing.assert_array_equal(turn(history, 7.0), turn(history, 7.0 - 360.0))


def test_a_cell_ahead_is_on_the_right_after_a_left_turn() -> None:
    grid = BevGrid(51, 51)
    history = np.zeros((51, 51, 1))
    history[45, 25] = 1  # twenty cells ahead
    row, column = np.argwhere(turn(history, 30.0, grid=grid)[..., 0])[0]
    assert (row - 25, column - 25) == (round(20 * np.cos(np.pi / 6)), round(20 * np.sin(np.pi / 6)))


def test_cells_from_outside_the_map_are_zero() -> None:
    turned = turn(np.ones((6, 6, 1)), 45.0)
    assert turned[0, 0] == 0
    assert turned[3, 3] == 1


def test_the_original_centre_is_cell_100_at_every_grid_size() -> None:
    history = np.random.default_rng(1).normal(size=(50, 50, 1))
    small = BevGrid(50, 50)
    np.testing.assert_array_equal(turn(history, 5.0, "original", small), turn(history, 5.0, (100.0, 100.0), small))
    assert not np.array_equal(turn(history, 5.0, "original", small), turn(history, 5.0, "center", small))
    large = BevGrid(200, 200)
    history = np.random.default_rng(1).normal(size=(200, 200, 1))
    np.testing.assert_array_equal(turn(history, 5.0, "original", large), turn(history, 5.0, "center", large))


def test_each_batch_element_is_rotated_by_its_own_angle() -> None:
    history = torch.randn(2, 36, 3)
    together = rotate_history(history, torch.tensor([10.0, -40.0]), SQUARE, "center")
    for i, degrees in enumerate((10.0, -40.0)):
        alone = rotate_history(history[i : i + 1], torch.tensor([degrees]), SQUARE, "center")
        assert torch.equal(together[i], alone[0])
