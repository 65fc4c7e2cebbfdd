"""The slopes of the road relative to the vehicle, which pitches and rolls, and images that are turned level with it.

Images of two frames tell the slopes: the vehicle travels along the road, so that its way in the images tells the pitch;
and how all points turn tells by how much pitch and roll changed. The boxes of a detector tell both once more
(`bevcli.model.lift`), less exactly.

With these slopes the network sees images as the cameras would see them if the vehicle stood level with the road: one
that was trained on level rigs loses a little more where only the rig is turned.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from bevcli.geometry.transforms import Array, Pose, inverse, rotation_about_z, yaw_of_rotation

SPREAD = 0.016  # standard deviation of a slope that nothing was measured of
DRIFT = 3.5e-4  # what the change of a slope between two frames is not known better than
POINTS, APART = 200, 8  # an image; pixels between them
WINDOW, LEVELS = (15, 15), 4  # of the optical flow
RETURNED = 0.7  # pixels within which a point that is followed there and back comes back
SCALE = 0.7  # of residuals, pixels: those far beyond are of what moves by itself
FEWEST, AGREE = 30, 0.6  # points; share of them within two scales. With less the poses are not of these images
STANDS_M = 0.05  # a shorter way shows no direction
STEPS, DIFFERENCE = 6, 1e-6
CONTRADICTS = 6.0  # square of the distance of two measured slopes, in standard deviations: one in twenty is as far off
LEVEL_FROM = 2.0  # squares of standard deviations that a slope exceeds before the rig is levelled by it


@dataclass(frozen=True)
class RoadSlopes:
    """Slopes of the road in the bev frame, along its x and y axis."""

    mean: Tensor  # (B, 2)
    covariance: Tensor  # (B, 2, 2)

    @classmethod
    def unknown(cls, device: torch.device | None = None) -> "RoadSlopes":
        """Where nothing was measured."""
        return cls(torch.zeros(1, 2, device=device), SPREAD**2 * torch.eye(2, device=device)[None])

    @classmethod
    def fitting(cls, information: Tensor, pull: Tensor) -> "RoadSlopes":
        """Of an information matrix (B, 2, 2) and its product (B, 2) with the slopes."""
        covariance = inverse_of_two(information)
        return cls((covariance * pull[:, None]).sum(-1), covariance)

    def joined(self, information: Tensor, pull: Tensor) -> "RoadSlopes":
        """With what was measured besides: its information matrix (B, 2, 2) and the product (B, 2) with the slopes."""
        own = inverse_of_two(self.covariance)
        return RoadSlopes.fitting(own + information, (own * self.mean[:, None]).sum(-1) + pull)

    def measured(self, others: "RoadSlopes") -> tuple[Tensor, Tensor]:
        """What `joined` takes of these slopes, which nothing was known of before; 0 where they contradict others."""
        own, off = inverse_of_two(self.covariance), self.mean - others.mean
        distance = (inverse_of_two(self.covariance + others.covariance) * off[:, None] * off[..., None]).sum((-2, -1))
        agrees = (distance < CONTRADICTS).to(own.dtype)[:, None, None]
        prior = torch.eye(2, device=own.device) / SPREAD**2
        return agrees * (own - prior), agrees[..., 0] * (own * self.mean[:, None]).sum(-1)

    def to(self, device: torch.device) -> "RoadSlopes":
        """On a device, by one copy."""
        numbers = torch.cat([self.mean[..., None], self.covariance], -1).to(device)
        return RoadSlopes(numbers[..., 0], numbers[..., 1:])

    @classmethod
    def of_names(cls, tensors: Mapping[str, Tensor]) -> "RoadSlopes | None":
        """Of the outputs of an exported file; None where it has none."""
        return cls(tensors["road_slopes"], tensors["road_covariance"]) if "road_slopes" in tensors else None


@dataclass(frozen=True)
class GreyView:
    """The images of a frame, small and grey."""

    images: tuple[Tensor, ...]  # of each camera (h, w) uint8, empty where there is no image
    image_from_bev: Tensor  # (N, 4, 4) float64, bev metres to pixels of these images
    ego_from_bev: Tensor  # (4, 4) float64


@dataclass(frozen=True)
class RoadMemory:
    """What is kept of a frame for the next one: its images, and the slopes that all of it told."""

    view: GreyView
    slopes: RoadSlopes


@dataclass(frozen=True)
class FollowedPoints:
    """What points told of the slopes that were followed from a frame before. It takes a tenth of a second."""

    view: GreyView  # of the frame before
    pose: Pose  # its world_from_ego
    told: tuple[Array, Array] | None  # see `slopes_by_points`

    @classmethod
    def follow(cls, view: GreyView, pose: Pose, next_view: GreyView, next_pose: Pose) -> "FollowedPoints":
        """From a frame to the next one."""
        first = _level(pose.matrix @ view.ego_from_bev.numpy())
        second = _level(next_pose.matrix @ next_view.ego_from_bev.numpy())
        return cls(view, pose, slopes_by_points(view, next_view, inverse(second) @ first))


def expected_slopes(memory: RoadMemory, points: FollowedPoints) -> RoadSlopes:
    """The slopes of a frame before its boxes are looked at. memory: of the frame that points were followed from."""
    if points.told is None:
        return RoadSlopes.unknown()
    information, pull = (x.copy() for x in points.told)
    old = np.linalg.inv(memory.slopes.covariance[0].double().numpy())
    information[:2, :2] += old
    pull[:2] += old @ memory.slopes.mean[0].double().numpy()
    information[2:, 2:] += np.eye(2) / SPREAD**2
    both = np.linalg.inv(information)
    numbers = (both @ pull)[2:], both[2:, 2:] + DRIFT**2 * np.eye(2)
    return RoadSlopes(*(torch.from_numpy(x)[None].float() for x in numbers))


def slopes_by_points(first: GreyView, second: GreyView, b_from_a: Array) -> tuple[Array, Array] | None:
    """What points of the images of two frames tell of the slopes (x, y of the first, x, y of the second).

    b_from_a: (4, 4) between the frames that the bev frames would be if the vehicle were level with the road.

    Returns the information matrix (4, 4) and its product (4,) with the slopes; None where too few points agree.
    """
    rays_a: list[Array] = []
    rays_b: list[Array] = []
    focal, shift = [], []
    matrices = first.image_from_bev.numpy(), second.image_from_bev.numpy()
    for image_a, image_b, from_bev_a, from_bev_b in zip(first.images, second.images, *matrices, strict=True):
        start, end = _followed(image_a.numpy(), image_b.numpy())
        turn_a, turn_b = (np.linalg.inv(matrix[:3, :3]) for matrix in (from_bev_a, from_bev_b))
        for rays, turn, pixels in ((rays_a, turn_a, start), (rays_b, turn_b, end)):
            way = np.column_stack([pixels, np.ones(len(pixels))]) @ turn.T
            rays.append(way / np.linalg.norm(way, axis=-1, keepdims=True))
        focal.append(np.full(len(start), 1 / np.linalg.norm(turn_b[:, 0])))
        at_a, at_b = -turn_a @ from_bev_a[:3, 3], -turn_b @ from_bev_b[:3, 3]
        shift.append(np.broadcast_to(b_from_a[:3, :3] @ at_a + b_from_a[:3, 3] - at_b, (len(start), 3)))
    a, b, pixels_of_ray, ways = (np.concatenate(x) for x in (rays_a, rays_b, focal, shift))
    if len(a) < FEWEST:
        return None
    stands = np.linalg.norm(b_from_a[:3, 3]) < STANDS_M
    ways = ways / np.maximum(np.linalg.norm(ways, axis=-1, keepdims=True), 1e-9)

    def residuals(slopes: Array) -> Array:
        """Distances from the epipolar lines; of a vehicle that stands, from where the points were. Pixels."""
        turn_a, turn_b = (np.array(level_from_bev(*pair)) for pair in (slopes[:2], slopes[2:]))
        turned, seen = a @ (b_from_a[:3, :3] @ turn_a).T, b @ turn_b.T
        if stands:
            return np.asarray((pixels_of_ray[:, None] * np.cross(turned, seen)).ravel())
        normal_a, normal_b = np.cross(ways, turned), np.cross(ways, seen)
        length = np.sqrt((normal_a**2).sum(-1) + (normal_b**2).sum(-1))
        return np.asarray(pixels_of_ray * (seen * normal_a).sum(-1) / np.maximum(length, 1e-9))

    slopes, prior = np.zeros(4), np.eye(4) / SPREAD**2
    for _ in range(STEPS):
        here = residuals(slopes)
        rows = np.stack([(residuals(slopes + step) - here) / DIFFERENCE for step in DIFFERENCE * np.eye(4)], -1)
        weights = 1 / (1 + (here / SCALE) ** 2) / (2 * SCALE**2)
        information, pull = rows.T @ (rows * weights[:, None]), rows.T @ (weights * here)
        slopes = slopes - np.linalg.solve(information + prior, pull + prior @ slopes)
    if (np.abs(residuals(slopes)) < 2 * SCALE).mean() < AGREE:
        return None
    return information, information @ slopes + prior @ slopes


def _followed(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> tuple[Array, Array]:
    """Pixels (n, 2) of points in two images."""
    nothing = np.zeros((0, 2)), np.zeros((0, 2))
    if first.shape != second.shape or not second.any():
        return nothing
    start = cv2.goodFeaturesToTrack(first, POINTS, 0.01, APART)
    if start is None:
        return nothing
    end, there, _ = cv2.calcOpticalFlowPyrLK(first, second, start, None, winSize=WINDOW, maxLevel=LEVELS)  # type: ignore[call-overload]
    back, again, _ = cv2.calcOpticalFlowPyrLK(second, first, end, None, winSize=WINDOW, maxLevel=LEVELS)  # type: ignore[call-overload]
    kept = (np.linalg.norm(back - start, axis=-1) < RETURNED).ravel() & (there.ravel() > 0) & (again.ravel() > 0)
    return start[kept, 0].astype(np.float64), end[kept, 0].astype(np.float64)


def level_from_bev(along_x: Any, along_y: Any) -> Any:
    """Three rows of three numbers or tensors, for a road with such slopes in the bev frame; the heading stays."""
    x = (1 + along_x**2) ** -0.5
    z = (1 + along_x**2 + along_y**2) ** -0.5
    left = -x * z * along_x * along_y, x * z * (1 + along_x**2), x * z * along_y
    return (x, 0 * x, x * along_x), left, (-z * along_x, -z * along_y, z)


def levelled(image_from_bev: Tensor, told: RoadSlopes, height_m: float) -> Tensor:
    """(B, N, 4, 4), pixels from a bev frame that is level with the road, turned about the point of the road below it.

    It is turned the less, the less sure the slopes are.

    image_from_bev: (B, N, 4, 4). told: on the same device. height_m: of the bev frame above the road.
    """
    slopes, information = told.mean, inverse_of_two(told.covariance)
    sureness = ((information * slopes[:, None]).sum(-1) * slopes).sum(-1)  # in squares of standard deviations
    slopes = slopes * (1 - LEVEL_FROM / sureness.clamp(min=LEVEL_FROM))[:, None]
    axes = [torch.stack(axis, -1) for axis in level_from_bev(*slopes.unbind(-1))]  # of the level frame
    bev_from_level = torch.eye(4, device=slopes.device).repeat(len(slopes), 1, 1)
    bev_from_level[:, :3, :3] = torch.stack(axes, -1)
    bev_from_level[:, :3, 3] = height_m * (axes[2] - slopes.new_tensor([0.0, 0.0, 1.0]))
    return image_from_bev @ bev_from_level[:, None]


def _level(world_from_bev: Array) -> Array:
    """(4, 4): a pose without pitch, roll and height."""
    level = np.eye(4)
    level[:3, :3] = rotation_about_z(yaw_of_rotation(world_from_bev[:3, :3]))
    level[:2, 3] = world_from_bev[:2, 3]
    return level


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
    """(B·N, 3, h, w), turned and reduced, cubic and so as sharp as they were. What no camera saw repeats the edge.

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
    places, images = places.unflatten(1, x.shape), images.flatten(0, 1)
    turned = F.grid_sample(images, places, mode="bicubic", padding_mode="border", align_corners=False)
    is_image = (pixels[..., :2] < edge[:, None] - 0.5).all(-1)  # (B·N, h, w)
    return turned * is_image[:, None]


def inverse_of_two(matrices: Tensor) -> Tensor:
    """Of symmetric matrices (..., 2, 2), by operations that exported files have; 0 for 0."""
    (xx, xy), (_, yy) = (row.unbind(-1) for row in matrices.unbind(-2))
    return (
        torch.stack([yy, -xy, -xy, xx], -1).unflatten(-1, (2, 2))
        / (xx * yy - xy * xy).clamp(min=1e-20)[..., None, None]
    )


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
