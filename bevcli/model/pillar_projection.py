"""Where the pillars of the BEV cells appear in the cameras, and which cameras see a cell (paper, section 3.3)."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

# Metres. Points nearer or behind the camera are not visible, and are projected as if they lay at this depth.
MIN_DEPTH = 1e-5


@dataclass(frozen=True)
class PillarProjection:
    """The pillars of every BEV cell in every camera.

    reference_points: (B, N, Y·X, Z, 2) float32, x and y, 0 to 1 over the padded image; up to 1e7 behind a camera.
    visible: (B, N, Y·X, Z) bool.
    """

    reference_points: Tensor
    visible: Tensor

    @property
    def hit(self) -> Tensor:
        """(B, N, Y·X) bool: the cells that attend in a camera: any point of their pillar is visible there."""
        return self.visible.any(-1)


@dataclass(frozen=True)
class PillarHits:
    """The ragged list of M hits, a (camera, cell) pair each, ordered by batch, camera, cell.

    cell: (M,) int64, index in B·Y·X. reference_points: (M, Z, 2). hits_per_camera: B·N counts, of sum M.
    cameras_per_cell: (B·Y·X,) int64, how many cameras see a cell.
    """

    cell: Tensor
    reference_points: Tensor
    hits_per_camera: tuple[int, ...]
    cameras_per_cell: Tensor


def project_points(image_from_bev: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """(..., 4, 4) and (..., 3) metres, bev frame -> pixels (..., 2) and depths in metres (...)."""
    # Sums of products, not matmul: lower-precision matrix units would move the points by pixels.
    projected = (image_from_bev[..., :3, :3] * points[..., None, :]).sum(-1) + image_from_bev[..., :3, 3]
    depth = projected[..., 2:]
    return projected[..., :2] / depth.clamp(min=MIN_DEPTH), depth[..., 0]


def project_pillars(
    image_from_bev: Tensor, pillars: Tensor, image_size: tuple[int, int], has_image: Tensor
) -> PillarProjection:
    """Projects 3D reference points into the cameras.

    image_from_bev: (B, N, 4, 4) float32. pillars: (Y·X, Z, 3) metres, bev frame. has_image: (B, N) bool.
    image_size: (height, width) of the network's input, padding included, pixels.
    """
    pixels, depth = project_points(image_from_bev.float()[:, :, None, None], pillars.float())
    height, width = image_size
    points = pixels / pixels.new_tensor([width, height])  # (B, N, Y·X, Z, 2)
    inside = ((points > 0) & (points < 1)).all(-1) & (depth > MIN_DEPTH)
    return PillarProjection(points, inside & has_image[:, :, None, None])


def find_hits(projection: PillarProjection) -> PillarHits:
    """Keeps only the pairs of a camera and a cell that it sees; the other pairs cost nothing from here on."""
    hit = projection.hit
    batch, camera, cell = hit.nonzero(as_tuple=True)
    return PillarHits(
        cell=batch * hit.shape[-1] + cell,
        reference_points=projection.reference_points[batch, camera, cell],
        hits_per_camera=tuple(hit.sum(-1).flatten().tolist()),
        cameras_per_cell=hit.sum(1).flatten(),
    )
