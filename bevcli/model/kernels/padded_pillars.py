"""The pillars of a model on a GPU: the CPU finds the hits, and pads them to sizes that a rig keeps."""

from functools import partial

import numpy as np
import torch
from torch import Tensor

from bevcli.model.kernels.compiled import in_threads
from bevcli.model.pillar_projection import MIN_DEPTH, PillarHits, Pillars
from bevcli.model.upload import upload_together

PLACES = 128  # numbers of padded hits are multiples of this


class PaddedPillars(Pillars):
    """`Pillars` on a GPU: nobody waits for the GPU to count the hits, whose tensors keep their shapes.

    Attributes:
        points_on_cpu: the points, on the CPU.
        sizes: by number of cameras and size of the images, the number of hits of each camera, added ones included.
    """

    points_on_cpu: Tensor
    sizes: dict[tuple[int, tuple[int, int]], tuple[int, ...]]

    def forward(self, image_from_bev: Tensor, image_size: tuple[int, int], has_image: Tensor) -> PillarHits:
        """As `Pillars.forward`; the hits are on the device."""
        hits = hits_on_cpu(image_from_bev, self.points_on_cpu, image_size, has_image)
        key = len(hits.hits_per_camera), image_size
        sizes = self.sizes.get(key, (0,) * key[0])
        if any(count > size for count, size in zip(hits.hits_per_camera, sizes, strict=True)):
            roomy = (min(len(self.points), _roomy(count)) for count in hits.hits_per_camera)
            sizes = self.sizes[key] = tuple(map(max, roomy, sizes))
        return upload_together(hits.padded(sizes), self.points.device)


def hits_on_cpu(image_from_bev: Tensor, points: Tensor, image_size: tuple[int, int], has_image: Tensor) -> PillarHits:
    """`find_hits` of `project_pillars`, by a compiled loop that keeps nothing of the points that no camera sees.

    points: (Y·X, Z, 3) on the CPU; other arguments as for `project_pillars`.
    """
    from bevcli.model.kernels.projection import find_hits  # loads the compiler

    batch, cameras = has_image.shape
    (total, heights, _), images = points.shape, batch * cameras
    cells = np.empty((images, total), dtype=np.int64)
    reference_points = np.empty((images, total, heights, 2), dtype=np.float32)
    counts = np.zeros(images, dtype=np.int64)
    matrices = image_from_bev.float().cpu().flatten(0, 1).contiguous().numpy()
    size = np.asarray(image_size, dtype=np.float32)
    read = matrices, points.float().contiguous().numpy(), has_image.cpu().flatten().numpy(), size
    written = cells, reference_points, counts
    in_threads(partial(find_hits, *read, np.float32(MIN_DEPTH), *written), images, min_range=1)
    found = [cells[image, :count] + image // cameras * total for image, count in enumerate(counts)]
    cell = np.concatenate(found)
    return PillarHits(
        cell=torch.from_numpy(cell),
        reference_points=torch.from_numpy(
            np.concatenate([reference_points[image, :count] for image, count in enumerate(counts)])
        ),
        hits_per_camera=tuple(counts.tolist()),
        cameras_per_cell=torch.from_numpy(np.bincount(cell, minlength=batch * total)),
    )


def _roomy(count: int) -> int:
    """A number of places for about `count` hits: the projections of a rig differ a little from frame to frame."""
    return -(-count * 9 // 8 // PLACES) * PLACES
