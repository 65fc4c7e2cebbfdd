"""Hits of the pillars for a GPU: found by a compiled loop, and padded, they give the results of the plain ones."""

from __future__ import annotations

import pytest
import torch

from bevcli.geometry.bev_grid import BevGrid
from bevcli.model.deformable_attention import FeatureMaps
from bevcli.model.encoder import SpatialCrossAttention
from bevcli.model.kernels.choose import in_place_of
from bevcli.model.kernels.compiled import CompiledSampling
from bevcli.model.kernels.gpu import PaddedPillars, hits_on_cpu
from bevcli.model.pillar_projection import PillarHits, Pillars

GRID = BevGrid(rows=10, columns=12)
SIZE = (96, 160)
CELLS = GRID.rows * GRID.columns


def projections(batch: int, cameras: int) -> torch.Tensor:
    """image_from_bev (B, N, 4, 4) of cameras that look into all directions."""
    generator = torch.Generator().manual_seed(batch * cameras)
    rotation, _ = torch.linalg.qr(torch.randn(batch, cameras, 3, 3, generator=generator))
    image_from_camera = torch.tensor([[90.0, 0, 80], [0, 90, 48], [0, 0, 1]])
    matrices = torch.eye(4).repeat(batch, cameras, 1, 1)
    matrices[..., :3, :3] = image_from_camera @ rotation
    matrices[..., :3, 3] = torch.randn(batch, cameras, 3, generator=generator)
    return matrices


def both(batch: int, cameras: int) -> tuple[PillarHits, PillarHits]:
    """The hits by the plain module and by the compiled loop; the second camera of the first element has no image."""
    pillars, matrices = Pillars(GRID), projections(batch, cameras)
    has_image = torch.ones(batch, cameras, dtype=torch.bool)
    has_image[0, 1:2] = False
    return pillars(matrices, SIZE, has_image), hits_on_cpu(matrices, pillars.points, SIZE, has_image)


@pytest.mark.parametrize(("batch", "cameras"), [(1, 1), (1, 6), (3, 2)])
def test_the_compiled_loop_finds_the_same_hits_bit_by_bit(batch, cameras):
    plain, compiled = both(batch, cameras)
    assert compiled.hits_per_camera == plain.hits_per_camera
    assert max(plain.hits_per_camera) > 0
    for name in ("cell", "reference_points", "cameras_per_cell"):
        torch.testing.assert_close(getattr(compiled, name), getattr(plain, name), rtol=0, atol=0)


def test_added_hits_change_no_bit_of_the_attention():
    _, hits = both(batch=2, cameras=3)
    torch.manual_seed(0)
    block = SpatialCrossAttention(16, heads=2, points=8, levels=2, dropout=0.1).eval()
    maps = FeatureMaps(torch.randn(6, 12 * 20 + 6 * 10, 16), ((12, 20), (6, 10)))
    query = 30 * torch.randn(2, CELLS, 16)
    padded = hits.padded([count + 37 * i for i, count in enumerate(hits.hits_per_camera)])
    assert len(padded.cell) == len(hits.cell) + 37 * 15
    assert padded.is_seen.sum() == len(hits.cell)
    for sampling in (block.attention.sampling, CompiledSampling()):
        block.attention.sampling = sampling
        with torch.inference_mode():
            torch.testing.assert_close(
                block(query, maps, padded), block(query, maps, hits), rtol=0, atol=0, msg=str(sampling)
            )


def test_a_rig_keeps_its_sizes_while_it_moves_a_little():
    pillars = Pillars(GRID)
    pillars = in_place_of(pillars, PaddedPillars, points_on_cpu=pillars.points, sizes={})
    matrices, has_image = projections(1, 6), torch.ones(1, 6, dtype=torch.bool)
    sizes = set()
    for step in range(5):
        moved = matrices.clone()
        moved[..., :3, 3] += 0.01 * step
        hits = pillars(moved, SIZE, has_image)
        assert len(hits.cell) == sum(hits.hits_per_camera)
        sizes.add(hits.hits_per_camera)
    assert len(sizes) == 1
    without = pillars(matrices, SIZE, torch.zeros(1, 6, dtype=torch.bool))
    assert without.hits_per_camera == sizes.pop()
    assert not without.is_seen.any()
