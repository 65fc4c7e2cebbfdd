"""Deformable attention compared with its definition as loops, and its initial weights."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from bevcli.model.deformable_attention import DeformableAttention, GridSampling, level_sizes, sampling_locations

SHAPES = ((4, 6), (2, 3))
sample = GridSampling()


def test_sampling_equals_its_definition_as_loops() -> None:
    random = np.random.default_rng(0)
    values = random.normal(size=(2, 30, 3, 4))
    locations = random.uniform(-0.3, 1.3, size=(5, 3, 2, 2, 2))
    weights = random.random((5, 3, 2, 2))
    ours = sample(
        torch.from_numpy(values).float(), SHAPES, torch.from_numpy(locations).float(), torch.from_numpy(weights), [2, 3]
    )
    np.testing.assert_allclose(ours, _by_loops(values, locations, weights, map_of_query=[0, 0, 1, 1, 1]), atol=1e-5)


def test_a_map_that_no_query_samples_changes_nothing() -> None:
    values, locations, weights = torch.randn(3, 24, 2, 4), torch.rand(6, 2, 1, 2, 2), torch.rand(6, 2, 1, 2)
    with_empty = sample(values, SHAPES[:1], locations, weights, [4, 0, 2])
    without = sample(values[[0, 2]], SHAPES[:1], locations, weights, [4, 2])
    assert torch.equal(with_empty, without)


def test_without_queries_the_result_has_no_rows() -> None:
    empty = sample(torch.randn(2, 24, 2, 4), SHAPES[:1], torch.rand(0, 2, 1, 2, 2), torch.rand(0, 2, 1, 2), [0, 0])
    assert empty.shape == (0, 8)


def test_samples_far_outside_the_map_are_zero() -> None:
    locations = torch.full((1, 1, 1, 1, 2), 6.7e6)
    assert torch.equal(
        sample(torch.ones(1, 24, 1, 4), SHAPES[:1], locations, torch.ones(1, 1, 1, 1), [1]), torch.zeros(1, 4)
    )


def test_gradients_reach_values_locations_and_weights() -> None:
    values = torch.randn(1, 30, 2, 2, dtype=torch.float32, requires_grad=True)
    locations = torch.rand(3, 2, 2, 2, 2, requires_grad=True)
    weights = torch.rand(3, 2, 2, 2, requires_grad=True)
    sample(values, SHAPES, locations, weights, [3]).square().sum().backward()
    for leaf in (values, locations, weights):
        assert leaf.grad is not None
        assert leaf.grad.abs().sum() > 0


def test_offsets_are_cells_of_their_own_level() -> None:
    offsets = torch.ones(1, 2, 1, 2)
    locations = sampling_locations(torch.full((1, 1, 1, 2), 0.5), offsets, level_sizes(SHAPES, offsets.device))
    expected = [[0.5 + 1 / 6, 0.5 + 1 / 4], [0.5 + 1 / 3, 0.5 + 1 / 2]]
    torch.testing.assert_close(locations[0, :, 0], torch.tensor(expected))


@pytest.mark.parametrize("heads", [4, 8])
def test_untrained_heads_sample_in_a_ring_with_equal_weights(heads: int) -> None:
    attention = DeformableAttention(16, 16, heads, points=3, levels=2)
    offsets, logits = attention.predict(torch.randn(5, 16))
    weights = attention.sampling.weights(logits)
    torch.testing.assert_close(weights, torch.full_like(weights, 1 / 6))
    for head in range(heads):
        angle = 2 * math.pi * head / heads
        direction = np.array([math.cos(angle), math.sin(angle)])
        direction /= abs(direction).max()
        for point in range(3):
            expected = np.broadcast_to((point + 1) * direction, (5, 1, 2, 2))
            np.testing.assert_allclose(offsets[:, head, :, :, point].detach(), expected, atol=1e-5)


def _by_loops(values: np.ndarray, locations: np.ndarray, weights: np.ndarray, map_of_query: list[int]) -> np.ndarray:
    queries, heads, levels, points = weights.shape
    out = np.zeros((queries, heads, values.shape[-1]))
    starts = [0, SHAPES[0][0] * SHAPES[0][1]]
    for query, head, level, point in np.ndindex(queries, heads, levels, points):
        height, width = SHAPES[level]
        x, y = locations[query, head, level, point] * (width, height) - 0.5
        for row, column in np.ndindex(height, width):
            share = max(0.0, 1 - abs(x - column)) * max(0.0, 1 - abs(y - row))
            value = values[map_of_query[query], starts[level] + row * width + column, head]
            out[query, head] += weights[query, head, level, point] * share * value
    return out.reshape(queries, -1)
