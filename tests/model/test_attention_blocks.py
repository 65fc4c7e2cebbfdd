"""Temporal self-attention and spatial cross-attention: what a cell attends to, and how results are averaged."""

from __future__ import annotations

import torch

from bevcli.model.deformable_attention import DeformableAttention, FeatureMaps
from bevcli.model.encoder import SpatialCrossAttention, TemporalSelfAttention
from bevcli.model.pillar_projection import PillarHits

CHANNELS, ROWS, COLUMNS = 8, 3, 5
CELLS = ROWS * COLUMNS


def pass_through(attention: DeformableAttention) -> None:
    """Makes an attention return the values at its reference points."""
    with torch.no_grad():
        attention.sampling_offsets.bias.zero_()
        for projection in (attention.value_projection, attention.output_projection):
            projection.weight.copy_(torch.eye(CHANNELS))
            projection.bias.zero_()


def centers() -> torch.Tensor:
    """(Y·X, 2) x and y of the cells' centres, 0 to 1 over the map."""
    x, y = (torch.arange(COLUMNS) + 0.5) / COLUMNS, (torch.arange(ROWS) + 0.5) / ROWS
    return torch.stack([x.repeat(ROWS), y.repeat_interleave(COLUMNS)], -1)


def test_temporal_self_attention_averages_a_cell_and_its_history() -> None:
    block = TemporalSelfAttention(CHANNELS, 2, 4, (ROWS, COLUMNS), dropout=0.1).eval()
    pass_through(block.attention)
    history, current = torch.randn(1, CELLS, CHANNELS), torch.randn(1, CELLS, CHANNELS)
    attended = block(
        current, torch.zeros(CELLS, CHANNELS), torch.stack([history, current], 1), centers().expand(1, 2, -1, -1)
    )
    torch.testing.assert_close(attended, (history + current) / 2, atol=1e-5, rtol=1e-5)


def test_shifted_reference_points_sample_neighbouring_history() -> None:
    block = TemporalSelfAttention(CHANNELS, 2, 4, (ROWS, COLUMNS), dropout=0.1).eval()
    pass_through(block.attention)
    history, current = torch.randn(1, CELLS, CHANNELS), torch.zeros(1, CELLS, CHANNELS)
    one_cell_along_x = centers() + torch.tensor([1 / COLUMNS, 0])
    reference = torch.stack([one_cell_along_x, centers()])[None]
    attended = block(current, torch.zeros(CELLS, CHANNELS), torch.stack([history, current], 1), reference)
    grid, old = attended.view(ROWS, COLUMNS, CHANNELS), history.view(ROWS, COLUMNS, CHANNELS)
    torch.testing.assert_close(grid[:, :-1], old[:, 1:] / 2, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(grid[:, -1], torch.zeros(ROWS, CHANNELS), atol=1e-5, rtol=0)


def test_spatial_cross_attention_averages_cameras_seeing_a_cell() -> None:
    block = SpatialCrossAttention(CHANNELS, heads=2, points=4, levels=1, dropout=0.1).eval()
    pass_through(block.attention)
    bias = torch.randn(CHANNELS)
    with torch.no_grad():
        block.attention.output_projection.bias.copy_(bias)
    tokens = torch.randn(2, 1, CHANNELS).expand(2, 12, -1)  # the same value in all of a camera's tokens
    hits = PillarHits(
        cell=torch.tensor([0, 1, 1]),
        reference_points=torch.full((3, 2, 2), 0.5),
        hits_per_camera=(2, 1),
        cameras_per_cell=torch.tensor([1, 2, 0]),
    )
    attended = block(torch.randn(1, 3, CHANNELS), FeatureMaps(tokens, ((3, 4),)), hits)[0]
    expected = torch.stack([tokens[0, 0], tokens[:, 0].mean(0), torch.zeros(CHANNELS)]) + bias
    torch.testing.assert_close(attended, expected, atol=1e-5, rtol=1e-5)


def test_sampling_points_alternate_between_the_pillars_heights() -> None:
    block = SpatialCrossAttention(CHANNELS, heads=1, points=4, levels=1, dropout=0.1).eval()
    pass_through(block.attention)
    with torch.no_grad():  # only point 2 has weight; it belongs to the first of two heights
        block.attention.attention_weights.bias.copy_(torch.tensor([0.0, 0, 100, 0]))
    tokens = torch.randn(1, 2, CHANNELS)  # one row of two cells
    hits = PillarHits(torch.tensor([0]), torch.tensor([[[0.25, 0.5], [0.75, 0.5]]]), (1,), torch.tensor([1]))
    attended = block(torch.zeros(1, 1, CHANNELS), FeatureMaps(tokens, ((1, 2),)), hits)
    torch.testing.assert_close(attended[0], tokens[0, :1], atol=1e-5, rtol=1e-5)
