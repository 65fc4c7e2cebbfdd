"""Pillars of the BEV cells in the cameras: where they appear, and which cameras see a cell (paper, section 3.3).

      bev frame                                   image of a camera (u, v), 0 to 1
      z ^   o  Z points above each of               +---------------+
        |   o  the Y·X cells                        |      x        |   camera sees the cell: a point is inside,
        |   o    (x, y, z, 1)                       |      x        |   and in front of it (d > 0)
        +---+---+---> x, y     -------------->      +------x--------+
            cell                image_from_bev             x            outside: not visible
                                = (u d, v d, d, 1)

`PillarHits` lists the pairs of a camera and a cell that it sees; only for these attention is computed.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from bevcli.geometry.bev_grid import BevGrid
from bevcli.model.upload import upload

# Metres. A point nearer than this, or behind the camera, is not visible and is projected as if it lay at this depth.
MIN_DEPTH = 1e-5
OUTSIDE = -1e4  # x and y of points that lie outside every image, whatever their offsets: samples there are zero


@dataclass(frozen=True)
class PillarProjection:
    """The pillar points of every BEV cell in every camera."""

    # (B, N, Y·X, Z, 2) float32, x and y, 0 to 1 over the padded image; up to 1e7 behind a camera
    reference_points: Tensor
    visible: Tensor  # (B, N, Y·X, Z) bool, whether a point lies inside the image and in front of the camera

    @property
    def hit(self) -> Tensor:
        """(B, N, Y·X) bool: whether a camera sees a cell, which is when any point of its pillar is visible."""
        return self.visible.any(-1)


@dataclass(frozen=True)
class PillarHits:
    """The list of all M pairs of a camera and a cell that it sees, ordered by batch element, camera, cell."""

    cell: Tensor  # (M,) int64, index of the cell in B·Y·X
    reference_points: Tensor  # (M, Z, 2) float32, x and y of the pillar's points, 0 to 1 over the padded image
    hits_per_camera: tuple[int, ...]  # B·N counts, of sum M
    cameras_per_cell: Tensor  # (B·Y·X,) int64, the number of cameras that see a cell

    @property
    def is_seen(self) -> Tensor:
        """(M,) bool: false for the hits that `padded` has added."""
        return (self.reference_points != OUTSIDE).flatten(1).any(-1)

    def padded(self, sizes: Sequence[int]) -> "PillarHits":
        """The same hits, and behind those of each camera as many as it lacks to `sizes`, which add zeros to cells.

        The added ones are spread over the cells, so that a GPU does not add all of them up in one place.
        """
        cell = torch.arange(sum(sizes), device=self.cell.device) % len(self.cameras_per_cell)
        points = self.reference_points.new_full((sum(sizes), *self.reference_points.shape[1:]), OUTSIDE)
        for unpadded, room in ((self.cell, cell), (self.reference_points, points)):
            parts = zip(unpadded.split(self.hits_per_camera), room.split(list(sizes)), strict=True)
            for of_camera, of_room in parts:
                of_room[: len(of_camera)] = of_camera
        return PillarHits(cell, points, tuple(sizes), self.cameras_per_cell)


class Pillars(nn.Module):
    """The pillars of a BEV grid. It has no parameters.

    Attributes:
        points: (Y·X, Z, 3) float32, metres, bev frame.
    """

    points: Tensor

    def __init__(self, grid: BevGrid) -> None:
        super().__init__()
        points = torch.as_tensor(grid.pillars(), dtype=torch.float32).flatten(0, 1)
        self.register_buffer("points", points, persistent=False)

    def forward(self, image_from_bev: Tensor, image_size: tuple[int, int], has_image: Tensor) -> PillarHits:
        """The pairs of a camera and a cell that it sees; arguments as for `project_pillars`."""
        return find_hits(project_pillars(image_from_bev, self.points, image_size, has_image))

    def project(self, image_from_bev: Tensor, image_size: tuple[int, int], has_image: Tensor) -> PillarProjection:
        """The pillars in every camera; arguments as for `project_pillars`."""
        return project_pillars(image_from_bev, self.points, image_size, has_image)


def project_points(image_from_bev: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels (..., 2) and depths (...) in metres of points in images.

    image_from_bev: (..., 4, 4). points: (..., 3) metres, bev frame.
    """
    # Sums of products, not matmul: lower-precision matrix units would move the points by pixels.
    projected = (image_from_bev[..., :3, :3] * points[..., None, :]).sum(-1) + image_from_bev[..., :3, 3]
    depth = projected[..., 2:]
    return projected[..., :2] / depth.clamp(min=MIN_DEPTH), depth[..., 0]


def project_pillars(
    image_from_bev: Tensor, pillars: Tensor, image_size: tuple[int, int], has_image: Tensor
) -> PillarProjection:
    """Projects the pillars' points into every camera, on the device of the pillars.

    Args:
        image_from_bev: (B, N, 4, 4) float32, bev metres to pixels of the network's input.
        pillars: (Y·X, Z, 3) metres, bev frame.
        image_size: (height, width) of the network's input, padding included, pixels.
        has_image: (B, N) bool; a camera without an image sees nothing.
    """
    device = pillars.device
    image_from_bev = upload(image_from_bev.float(), device)
    pixels, depth = project_points(image_from_bev[:, :, None, None], pillars.float())
    height, width = image_size
    points = torch.stack([pixels[..., 0] / width, pixels[..., 1] / height], dim=-1)  # (B, N, Y·X, Z, 2)
    inside = ((points > 0) & (points < 1)).all(-1) & (depth > MIN_DEPTH)
    return PillarProjection(points, inside & upload(has_image, device)[:, :, None, None])


def find_hits(projection: PillarProjection) -> PillarHits:
    """The pairs of a camera and a cell that it sees; attention is computed for these only.

    The CPU reads the counts of the cameras from the device and waits for these, and for nothing else.
    """
    hit = projection.hit
    _, cameras, cells = hit.shape
    hits_per_camera = tuple(hit.sum(-1).flatten().tolist())
    # The positions of true elements in B·N·Y·X, as `nonzero` without its wait: all false elements write to one more
    # place at the end, which is cut off.
    mask, count = hit.flatten(), sum(hits_per_camera)
    order = mask.cumsum(0)  # from 1, at the true elements
    position = (order - 1).masked_fill(~mask, count)
    index = order.new_empty(count + 1).scatter_(0, position, torch.arange(len(mask), device=mask.device))[:count]
    batch = index // (cameras * cells)
    return PillarHits(
        cell=batch * cells + index % cells,
        reference_points=projection.reference_points.flatten(0, 2).index_select(0, index),
        hits_per_camera=hits_per_camera,
        cameras_per_cell=hit.sum(1).flatten(),
    )
