"""Images as the cameras would see them if the vehicle stood level with the road: the network knows no others.

A network that was trained on level rigs loses a fifth of its objects at one degree of pitch, however exactly the rig
states it. So the images are turned, not only the rig.
"""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor


def upright_cameras(image_from_bev: Tensor, image_from_level: Tensor) -> tuple[Tensor, Tensor]:
    """The cameras turned as a level vehicle would hold them, and the images that they have, from those at hand.

    Args:
        image_from_bev: (B, N, 4, 4), of the vehicle as it stands, pixels (rows u·d, v·d, d, 1).
        image_from_level: (B, N, 4, 4), the same cameras, from a bev frame that is level with the road.

    Returns upright_from_level (B, N, 4, 4), and image_from_upright (B, N, 3, 3) between pixels (rows u·d, v·d, d).
    """
    upright, level = image_from_bev[..., :3, :3], image_from_level[..., :3, :3]
    upright_from_image = upright @ inverse_of_three(level)
    upright_from_level = torch.cat([upright, upright_from_image @ image_from_level[..., :3, 3:]], -1)
    return torch.cat([upright_from_level, image_from_bev[..., 3:, :]], -2), level @ inverse_of_three(upright)


def upright_images(images: Tensor, image_from_upright: Tensor, sizes: Tensor, size: Sequence[int]) -> Tensor:
    """(B·N, 3, h, w), turned and reduced. What no camera saw repeats the edge of its image.

    Args:
        images: (B, N, 3, H, W), normalised and padded with zeros.
        image_from_upright: (B, N, 3, 3), pixels of `images`.
        sizes: (B, N, 2) width and height of the images within their padding.
        size: h and w.
    """
    height, width = images.shape[-2:]
    rows, columns = (
        (torch.arange(small, device=images.device) + 0.5) * (large / small) - 0.5
        for large, small in zip((height, width), size, strict=True)
    )
    y, x = torch.meshgrid(rows, columns, indexing="ij")
    pixels = torch.stack([x, y, torch.ones_like(x)], -1)
    seen = pixels.flatten(0, 1) @ image_from_upright.flatten(0, 1).transpose(-1, -2)  # (B·N, h·w, 3)
    edge = sizes.flatten(0, 1)[:, None]
    seen = torch.minimum((seen[..., :2] / seen[..., 2:]).clamp(min=0), edge - 1)
    places = (2 * seen + 1) / seen.new_tensor([width, height]) - 1
    turned = F.grid_sample(images.flatten(0, 1), places.unflatten(1, x.shape), align_corners=False)
    is_image = (pixels[..., :2] < edge[:, None] - 0.5).all(-1)  # (B·N, h, w)
    return turned * is_image[:, None]


def inverse_of_three(matrices: Tensor) -> Tensor:
    """Of matrices (..., 3, 3), by operations that exported files have."""
    inverse = adjugate_of_three(matrices)
    return inverse / (matrices[..., :1, :] @ inverse[..., :, :1])


def adjugate_of_three(matrices: Tensor) -> Tensor:
    """The inverse of matrices (..., 3, 3) times their determinant."""
    a, b, c = matrices.unbind(-2)
    return torch.stack([_cross(b, c), _cross(c, a), _cross(a, b)], -1)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    """The cross product (..., 3)."""
    (a0, a1, a2), (b0, b1, b2) = a.unbind(-1), b.unbind(-1)
    return torch.stack([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0], -1)
