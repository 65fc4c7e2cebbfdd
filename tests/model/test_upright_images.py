"""Images turned as the cameras of a level vehicle would see them."""

import numpy as np
import pytest
import torch
from torch import Tensor

from bevcli.model.road_slopes import level_from_bev, upright_cameras, upright_images

WIDTH, HEIGHT = 160, 96
INTRINSICS = torch.tensor([[120.0, 0, 79.5], [0, 120, 47.5], [0, 0, 1]])
LOOKS_AHEAD = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # camera from bev: y ahead, z up
CENTER = torch.tensor([0.2, 1.5, 0.4])


def camera(turn: Tensor, center: Tensor) -> Tensor:
    """(1, 1, 4, 4), of a bev frame from which the camera's axes are turned."""
    matrix = torch.eye(4)
    matrix[:3, :3] = INTRINSICS @ LOOKS_AHEAD @ turn
    matrix[:3, 3] = -matrix[:3, :3] @ center
    return matrix.view(1, 1, 4, 4)


def picture(image_from_bev: Tensor) -> Tensor:
    """(1, 1, 3, H, W): a smooth colour of each direction."""
    y, x = torch.meshgrid(torch.arange(float(HEIGHT)), torch.arange(float(WIDTH)), indexing="ij")
    ray = torch.stack([x, y, torch.ones_like(x)], -1) @ torch.linalg.inv(image_from_bev[0, 0, :3, :3]).T
    return torch.sin(5 * ray / ray.norm(dim=-1, keepdim=True)).movedim(-1, 0).view(1, 1, 3, HEIGHT, WIDTH)


def test_images_and_cameras_are_those_of_a_level_vehicle() -> None:
    """Each pixel has the colour of its direction; the centre of the camera is where the tilted vehicle holds it."""
    level = torch.from_numpy(level_from_bev(np.array([0.02, -0.03]))).float()
    image_from_bev, at = camera(torch.eye(3), CENTER), level @ CENTER
    image_from_level = camera(level.T, at)
    upright_from_level, image_from_upright = upright_cameras(image_from_bev, image_from_level)
    torch.testing.assert_close(upright_from_level, camera(torch.eye(3), at), rtol=0, atol=1e-4)
    images, sizes = picture(image_from_level), torch.tensor([[[WIDTH, HEIGHT]]]).float()
    turned = upright_images(images, image_from_upright, sizes, (HEIGHT, WIDTH))[0]
    expected = picture(upright_from_level)[0, 0]
    inside = slice(8, -8)
    assert (images[0, 0] - expected)[:, inside, inside].abs().max() > 0.1
    torch.testing.assert_close(turned[:, inside, inside], expected[:, inside, inside], rtol=0, atol=2e-3)


@pytest.mark.parametrize("size", [(HEIGHT, WIDTH), (64, 107)])
def test_images_of_a_level_vehicle_are_only_reduced(size: tuple[int, int]) -> None:
    """Padding stays zero; what lies beyond an edge repeats it."""
    images, sizes = torch.rand(1, 2, 3, HEIGHT, WIDTH), torch.tensor([[[WIDTH, HEIGHT], [WIDTH, 80]]]).float()
    images[0, 1, :, 80:] = 0
    same = torch.eye(3).expand(1, 2, 3, 3)
    expected = torch.nn.functional.interpolate(images[0], size, mode="bilinear", align_corners=False)
    reduced = upright_images(images, same, sizes, size)
    rows = int(79 * size[0] / HEIGHT)
    torch.testing.assert_close(reduced[0], expected[0], rtol=0, atol=1e-4)
    torch.testing.assert_close(reduced[1, :, : rows - 1], expected[1, :, : rows - 1], rtol=0, atol=1e-4)
    assert not reduced[1, :, rows + 2 :].any()
    moved = torch.eye(3)
    moved[0, 2] = -5.0  # five pixels to the left lies what the first column shows
    edge = upright_images(images, moved.expand(1, 2, 3, 3), sizes, (HEIGHT, WIDTH))
    torch.testing.assert_close(edge[0, :, :, :5], images[0, 0, :, :, :1].expand(-1, -1, 5), rtol=0, atol=1e-4)
