"""Pillars in the cameras, compared with OpenCV's projection; the list of hits, also padded and by a compiled loop."""

import cv2
import numpy as np
import original_reference as original
import pytest
import torch

from bevcli.config import load_config
from bevcli.geometry.bev_grid import BevGrid
from bevcli.model.deformable_attention import FeatureMaps
from bevcli.model.encoder import SpatialCrossAttention
from bevcli.model.kernels.choose import change_classes
from bevcli.model.kernels.compiled import CompiledSampling
from bevcli.model.kernels.gpu import PaddedPillars, hits_on_cpu
from bevcli.model.pillar_projection import PillarHits, PillarProjection, Pillars, find_hits, project_pillars

SIZE = (480, 800)


def test_pillars_of_a_real_rig_are_projected_as_by_opencv() -> None:
    config = load_config("tiny")
    pillars = config.bev_grid.pillars().reshape(-1, 4, 3)
    ours = project_pillars(
        torch.from_numpy(original.image_from_bev(0, config)).float()[None],
        torch.from_numpy(pillars).float(),
        SIZE,
        torch.ones(1, 6, dtype=torch.bool),
    )
    for i, name in enumerate(config.cameras):
        camera = original.frames()[0]["cams"][name]
        camera_from_bev = np.array(camera["sensor2lidar_rotation"]).T
        translation = -camera_from_bev @ np.array(camera["sensor2lidar_translation"])
        intrinsics = np.diag([0.5, 0.5, 1]) @ np.array(camera["cam_intrinsic"])
        pixels, _ = cv2.projectPoints(
            pillars.reshape(-1, 3), cv2.Rodrigues(camera_from_bev)[0], translation, intrinsics, None
        )
        depth = (pillars @ camera_from_bev.T + translation)[..., 2]
        pixels = pixels.reshape(-1, 4, 2)
        in_image = ((pixels > 0) & (pixels < (800, 480))).all(-1) & (depth > 0)
        visible = ours.visible[0, i].numpy()
        assert (visible != in_image).sum() <= 2  # points on the edge of an image
        both = visible & in_image
        np.testing.assert_allclose(ours.reference_points[0, i].numpy()[both] * (800, 480), pixels[both], atol=0.01)


def test_hits_list_every_visible_pair_of_camera_and_cell_once() -> None:
    visible = torch.zeros(2, 3, 4, 2, dtype=torch.bool)
    for batch, camera, cell in ((0, 0, 1), (0, 2, 1), (0, 2, 3), (1, 1, 0)):
        visible[batch, camera, cell, 1] = True
    reference_points = torch.rand(2, 3, 4, 2, 2)
    hits = find_hits(PillarProjection(reference_points, visible))
    assert hits.cell.tolist() == [1, 1, 3, 4]
    assert hits.hits_per_camera == (1, 0, 2, 0, 1, 0)
    assert hits.cameras_per_cell.tolist() == [0, 2, 0, 1, 1, 0, 0, 0]
    assert torch.equal(hits.reference_points[2], reference_points[0, 2, 3])


GRID = BevGrid(rows=10, columns=12)
SMALL_SIZE = (96, 160)
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
    return pillars(matrices, SMALL_SIZE, has_image), hits_on_cpu(matrices, pillars.points, SMALL_SIZE, has_image)


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
    change_classes(pillars, {Pillars: PaddedPillars}, points_on_cpu=pillars.points, sizes={})
    matrices, has_image = projections(1, 6), torch.ones(1, 6, dtype=torch.bool)
    sizes = set()
    for step in range(5):
        moved = matrices.clone()
        moved[..., :3, 3] += 0.01 * step
        hits = pillars(moved, SMALL_SIZE, has_image)
        assert len(hits.cell) == sum(hits.hits_per_camera)
        sizes.add(hits.hits_per_camera)
    assert len(sizes) == 1
    without = pillars(matrices, SMALL_SIZE, torch.zeros(1, 6, dtype=torch.bool))
    assert without.hits_per_camera == sizes.pop()
    assert not without.is_seen.any()
