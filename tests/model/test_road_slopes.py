"""The pitch and roll of the vehicle, by points of two frames; and images turned as those of a level vehicle."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from bevcli.geometry.transforms import Pose
from bevcli.model.road_slopes import (
    SPREAD,
    FollowedPoints,
    GreyView,
    RoadMemory,
    RoadSlopes,
    expected_slopes,
    level_from_bev,
    upright_cameras,
    upright_images,
)

WIDTH, HEIGHT, FOCAL = 512, 288, 280.0
POINTS = np.random.default_rng(0).uniform((-40, -40, -1.5), (40, 40, 6), (4000, 3))
SHADES = np.random.default_rng(1).integers(80, 255, len(POINTS))
YAWS = np.radians([0, 90, 180, 270])


def seen(slopes=(0.0, 0.0), ahead=0.0) -> GreyView:
    """Dots around a rig of four cameras that travelled `ahead` metres along y and is tilted by slopes."""
    images, projections = np.zeros((len(YAWS), HEIGHT, WIDTH), np.uint8), []
    points = (POINTS - [0.0, ahead, 0.0]) @ np.array(level_from_bev(*slopes))  # in the tilted bev frame
    for image, yaw in zip(images, YAWS, strict=True):
        right, forward = (np.cos(yaw), np.sin(yaw), 0.0), (-np.sin(yaw), np.cos(yaw), 0.0)
        camera_from_bev = np.array([right, (0.0, 0.0, -1.0), forward])
        matrix = np.eye(4)
        matrix[:3, :3] = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]]) @ camera_from_bev
        projections.append(matrix)
        at = points @ matrix[:3, :3].T
        for (u, v, depth), shade in zip(at, SHADES, strict=True):
            if depth > 4 and 2 < u / depth < WIDTH - 3 and 2 < v / depth < HEIGHT - 3:
                column, row = u / depth, v / depth
                x, y = int(column), int(row)
                for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):  # spread over pixels by nearness
                    weight = (1 - abs(column - x - i)) * (1 - abs(row - y - j))
                    image[y + j, x + i] = max(image[y + j, x + i], shade * weight)
    return GreyView(
        torch.from_numpy(images), torch.from_numpy(np.stack(projections)), torch.eye(4, dtype=torch.float64)
    )


def told(before: GreyView, now: GreyView, ahead: float, known: RoadSlopes | None = None) -> RoadSlopes:
    """What is expected of the second frame; known: of the first."""
    memory = RoadMemory(before, known or RoadSlopes.unknown())
    poses = [Pose.from_matrix(np.block([[np.eye(3), np.array([[0], [y], [0]])], [np.zeros(3), 1]])) for y in (0, ahead)]
    return expected_slopes(memory, FollowedPoints.follow(before, poses[0], now, poses[1]))


def test_the_way_along_the_road_tells_the_pitch_and_turns_tell_changes():
    first, second = (0.004, -0.01), (-0.006, 0.015)  # along x: roll, along y: pitch
    before, now = seen(first), seen(second, ahead=2.0)
    alone = told(before, now, 2.0)
    assert alone.mean[0, 1] == pytest.approx(second[1], abs=0.002)
    assert alone.covariance[0, 1, 1] ** 0.5 < 0.006 < 0.5 * SPREAD < alone.covariance[0, 0, 0] ** 0.5
    known = RoadSlopes(torch.tensor([first]), 1e-7 * torch.eye(2)[None])
    assert told(before, now, 2.0, known).mean[0].tolist() == pytest.approx(second, abs=0.001)


def test_a_vehicle_that_stands_keeps_what_was_known():
    first, second = (0.004, -0.01), (-0.006, 0.015)
    known = RoadSlopes(torch.tensor([first]), 1e-6 * torch.eye(2)[None])
    result = told(seen(first), seen(second), 0.0, known)
    assert result.mean[0].tolist() == pytest.approx(second, abs=0.001)


def test_nothing_is_told_by_poses_of_other_images_nor_by_empty_ones():
    before, now = seen(), seen(ahead=2.5)
    black, missing = (torch.zeros(shape, dtype=torch.uint8) for shape in ((HEIGHT, WIDTH), (0, 0)))
    empty = [replace(now, images=(image,) * len(YAWS)) for image in (black, missing)]
    sideways = Pose.from_matrix(np.block([[np.eye(3), np.array([[3.0], [0], [0]])], [np.zeros(3), 1]]))
    memory = RoadMemory(before, RoadSlopes(torch.ones(1, 2), 1e-6 * torch.eye(2)[None]))
    for view in (now, *empty):
        result = expected_slopes(memory, FollowedPoints.follow(before, Pose.identity(), view, sideways))
        assert torch.equal(result.covariance, RoadSlopes.unknown().covariance)
        assert not result.mean.any()


def test_a_camera_that_lacks_an_image_in_one_of_the_frames_is_left_out():
    slopes = (-0.006, 0.015)
    before, now = seen(), seen(slopes, ahead=2.0)
    none = torch.zeros(0, 0, dtype=torch.uint8)
    before = replace(before, images=(*before.images[:3], none))
    now = replace(now, images=(none, *now.images[1:]))
    known = RoadSlopes(torch.zeros(1, 2), 1e-7 * torch.eye(2)[None])
    assert told(before, now, 2.0, known).mean[0].tolist() == pytest.approx(slopes, abs=0.001)


WIDE, HIGH = 160, 96
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
    y, x = torch.meshgrid(torch.arange(float(HIGH)), torch.arange(float(WIDE)), indexing="ij")
    ray = torch.stack([x, y, torch.ones_like(x)], -1) @ torch.linalg.inv(image_from_bev[0, 0, :3, :3]).T
    return torch.sin(5 * ray / ray.norm(dim=-1, keepdim=True)).movedim(-1, 0).view(1, 1, 3, HIGH, WIDE)


def test_images_and_cameras_are_those_of_a_level_vehicle() -> None:
    """Each pixel has the colour of its direction; the centre of the camera is where the tilted vehicle holds it."""
    level = torch.tensor(level_from_bev(0.02, -0.03))
    image_from_bev, at = camera(torch.eye(3), CENTER), level @ CENTER
    image_from_level = camera(level.T, at)
    upright_from_level, image_from_upright = upright_cameras(image_from_bev, image_from_level)
    torch.testing.assert_close(upright_from_level, camera(torch.eye(3), at), rtol=0, atol=1e-4)
    images, sizes = picture(image_from_level), torch.tensor([[[WIDE, HIGH]]]).float()
    turned = upright_images(images, image_from_upright, sizes, (HIGH, WIDE))[0]
    expected = picture(upright_from_level)[0, 0]
    inside = slice(8, -8)
    assert (images[0, 0] - expected)[:, inside, inside].abs().max() > 0.1
    torch.testing.assert_close(turned[:, inside, inside], expected[:, inside, inside], rtol=0, atol=3e-3)


@pytest.mark.parametrize("size", [(HIGH, WIDE), (64, 107)])
def test_images_of_a_level_vehicle_are_only_reduced(size: tuple[int, int]) -> None:
    """Padding stays zero; what lies beyond an edge repeats it."""
    images, sizes = torch.rand(1, 2, 3, HIGH, WIDE), torch.tensor([[[WIDE, HIGH], [WIDE, 80]]]).float()
    images[0, 1, :, 80:] = 0
    same = torch.eye(3).expand(1, 2, 3, 3)
    expected = torch.nn.functional.interpolate(images[0], size, mode="bicubic", align_corners=False)
    reduced = upright_images(images, same, sizes, size)
    rows = int(79 * size[0] / HIGH)
    torch.testing.assert_close(reduced[0], expected[0], rtol=0, atol=1e-4)
    torch.testing.assert_close(reduced[1, :, : rows - 1], expected[1, :, : rows - 1], rtol=0, atol=1e-4)
    assert not reduced[1, :, rows + 2 :].any()
    moved = torch.eye(3)
    moved[0, 2] = -5.0  # five pixels to the left lies what the first column shows
    edge = upright_images(images, moved.expand(1, 2, 3, 3), sizes, (HIGH, WIDE))
    torch.testing.assert_close(edge[0, :, :, :5], images[0, 0, :, :, :1].expand(-1, -1, 5), rtol=0, atol=1e-4)
