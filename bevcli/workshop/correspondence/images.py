"""Grey images of one size, and what two of them show: points by SIFT features that match, and the road.

Features are found an image, and matched two images, so that a caller keeps no more images than it wants. For points of
the road, the second image is warped onto the first as a flat road would be seen. What is left between the two images is
measured by optical flow.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.cameras import OUTSIDE, Camera
from bevcli.geometry.transforms import Array
from bevcli.workshop.correspondence.residuals import GroupGeometry, rays_of_road_points

WIDTH, MOST_ENLARGED = 1000, 2  # pixels: all images are brought to this width; largest factor
THREADS = min(os.cpu_count() or 1, 8)  # each needs about 150 MB while it finds features
DARKEST = 4  # grey levels of standard deviation; an image with less shows nothing
SMOOTHING, COARSE = 1.2, 35  # pixels: finer structure is noise, coarser is light and shade
FLAT = 1.0  # grey levels, a weaker structure is noise
# The road.
NEAREST, FARTHEST = 1.3, 9.0  # road points, from the camera, in heights of the camera
WIDEST_M = 10.0  # from the way of the vehicle: farther aside are pavements
STRIDE = 8  # pixels between the points at which the warping is computed; between them it is interpolated
SPACING = 16  # pixels between the points whose flow is measured
WINDOW = 21  # pixels
MOST_BACK_PX = 0.5  # between a point and the flow there and back
FEWEST = 12  # points of a pair of images; fewer are not used
FULL_CONTRAST = 30.0  # mean squared gradient per pixel of a window, grey levels², from which a point counts fully
LEAST_NOISE = 0.5  # the same of the difference of two windows
AXES = np.eye(2)
DISTANCES, ANGLES_DEG = np.linspace(2.0, 8.0, 60), np.linspace(-35, 35, 100)  # of road points; in heights of the camera
TILES, POINTS = (6, 10), (10, 10)  # of the road: each has a level of its own, such as that of the pavement


@dataclass(frozen=True)
class GreyImage:
    """One camera's image at one time."""

    pixels: NDArray[np.uint8]  # (h, w) grey, at most WIDTH wide
    texture: NDArray[np.uint8]  # (h, w) fine structure with even contrast, without light and shade


def reduced(camera: Camera, width: int = WIDTH) -> Camera:
    """The camera of the reduced image. Its pixel (0, 0) is the centre of a larger pixel, so that coordinates shift."""
    width = min(width, MOST_ENLARGED * camera.width)
    size = (width, round(camera.height * width / camera.width))
    scaled = camera.scaled(size[0] / camera.width, size[1] / camera.height)
    scaled.intrinsics[:2, 2] += (np.array([scaled.width / camera.width, scaled.height / camera.height]) - 1) / 2
    return scaled


def grey_image(pixels_bgr: NDArray[np.uint8], camera: Camera) -> GreyImage | None:
    """An image (H, W, 3) as a camera of `reduced` sees it; None where it shows nothing."""
    size = (camera.width, camera.height)
    filtering = cv2.INTER_AREA if camera.width < pixels_bgr.shape[1] else cv2.INTER_CUBIC
    grey = cv2.cvtColor(pixels_bgr, cv2.COLOR_BGR2GRAY)
    pixels = cv2.resize(grey, size, interpolation=filtering) if grey.shape[::-1] != size else grey
    if pixels.std() < DARKEST:
        return None
    return GreyImage(np.asarray(pixels, dtype=np.uint8), texture(pixels))


def texture(pixels: NDArray[Any], seen: NDArray[np.bool_] | None = None) -> NDArray[np.uint8]:
    """The fine structure (h, w) of grey pixels (h, w) with even contrast; 128 where nothing is `seen` (h, w)."""
    smooth = cv2.GaussianBlur(pixels.astype(np.float32), (0, 0), SMOOTHING)
    fine = smooth - _mean(smooth, seen)
    contrast = np.sqrt(np.maximum(_mean(fine**2, seen), 0)) + FLAT
    levels = np.clip(128 + 40 * fine / contrast, 0, 255).astype(np.uint8)
    return levels if seen is None else np.where(seen, levels, np.uint8(128))


def _mean(values: NDArray[Any], seen: NDArray[np.bool_] | None) -> NDArray[Any]:
    """The mean around each pixel, of what is seen."""
    if seen is None:
        return cv2.blur(values, (COARSE, COARSE))
    share = seen.astype(np.float32)
    return cv2.blur(values * share, (COARSE, COARSE)) / np.maximum(cv2.blur(share, (COARSE, COARSE)), 1e-3)


FEATURES = 2000  # an image
RATIO = 0.75  # of the distances to the best and the second best match
INLIER_PX = 1.5
FEWEST_IN_PAIR = 15  # matches of a pair of images; fewer are not used
FEWEST_AT_ONCE = 100  # of two cameras at one time; those of a narrow strip fit many motions
CELLS = (10, 6)  # of an image, across and down;
MOST_IN_CELL = 6  # matches in one of them, so that no object counts for all
FLATTEST = 0.25  # cosine of the largest angle off the optical axis of a matched ray


@dataclass(frozen=True)
class Features:
    """The features of an image."""

    pixels: Array  # (F, 2)
    descriptors: NDArray[np.float32]  # (F, 128)


def features(image: GreyImage, seen: NDArray[np.bool_] | None = None) -> Features:
    """The features of an image, of the part that is `seen` (h, w)."""
    detector = cv2.SIFT.create(nfeatures=FEATURES, enable_precise_upscale=True)
    points, descriptors = detector.detectAndCompute(image.pixels, None if seen is None else seen.astype(np.uint8))
    if descriptors is None:
        return Features(np.zeros((0, 2)), np.zeros((0, 128), dtype=np.float32))
    pixels = np.array([point.pt for point in points], dtype=np.float64)
    return Features(pixels, np.asarray(descriptors, dtype=np.float32))


def neighbours(cameras: Sequence[Camera]) -> list[tuple[int, int]]:
    """Each camera with the next ones to the left and to the right, as indices."""
    around = np.argsort([camera.yaw for camera in cameras]).tolist()
    pairs = {(a, b) for a, b in zip(around, around[1:] + around[:1], strict=True) if a != b}
    return sorted(pairs | {(b, a) for a, b in pairs})


def matched(a: Features, b: Features, first: Camera, second: Camera, *, at_once: bool = False) -> tuple[Array, Array]:
    """Rays (m, 3) and (m, 3) of the matches.

    Those within one camera fit one rigid motion; and those of two cameras, if their images are of one time (`at_once`).
    """
    nothing = np.zeros((0, 3)), np.zeros((0, 3))
    if min(len(a.pixels), len(b.pixels)) < FEWEST_IN_PAIR:
        return nothing
    nearest, quality, other = _nearest(a.descriptors, b.descriptors)
    kept = quality < RATIO**2 * other
    if kept.sum() < FEWEST_IN_PAIR:
        return nothing
    pixels_a, quality = a.pixels[kept], quality[kept]
    rays_a, rays_b = first.rays(pixels_a), second.rays(b.pixels[nearest[kept]])
    with np.errstate(invalid="ignore"):
        good = (rays_a[:, 2] > FLATTEST) & (rays_b[:, 2] > FLATTEST)
    if at_once or first.name == second.name:
        good[good] = _rigid(rays_a[good], rays_b[good], first)
    indices = np.flatnonzero(good)
    # SIFT gives a point with several orientations several times.
    indices = indices[np.sort(np.unique(pixels_a[indices].astype(int), axis=0, return_index=True)[1])]
    indices = indices[_spread(pixels_a[indices], quality[indices].astype(np.float64), first)]
    if at_once and len(indices) < FEWEST_AT_ONCE:
        return nothing
    return rays_a[indices], rays_b[indices]


def _nearest(
    a: NDArray[np.float32], b: NDArray[np.float32]
) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float32]]:
    """The nearest of the descriptors b (F, 128) for each of a (A, 128); squared distances to it and to the next one.

    A matrix product is three times as fast as OpenCV's matcher, and as exact: SIFT's descriptors are whole numbers.
    """
    distances = (b**2).sum(-1) - 2 * (a @ b.T)
    rows, nearest = np.arange(len(a)), distances.argmin(-1)
    best = distances[rows, nearest]
    distances[rows, nearest] = np.inf
    lengths = (a**2).sum(-1)
    return nearest, lengths + best, lengths + distances.min(-1)


def _rigid(rays_a: Array, rays_b: Array, camera: Camera) -> NDArray[np.bool_]:
    """(m,) the matches that one rigid motion explains: all others move by themselves, or are wrong."""
    nothing = np.zeros(len(rays_a), dtype=bool)
    if len(rays_a) < FEWEST_IN_PAIR:
        return nothing
    flat_a, flat_b = (rays[:, :2] / rays[:, 2:] for rays in (rays_a, rays_b))
    threshold = INLIER_PX / camera.intrinsics[0, 0]
    _, inliers = cv2.findEssentialMat(flat_a, flat_b, np.eye(3), cv2.RANSAC, 0.999, threshold)
    if inliers is None or inliers.sum() < FEWEST_IN_PAIR:
        return nothing
    return np.asarray(inliers.ravel() > 0)


def _spread(pixels: Array, distance: Array, camera: Camera) -> NDArray[np.int64]:
    cell = (pixels / [camera.width, camera.height] * CELLS).astype(int).clip(0, np.array(CELLS) - 1) @ [1, CELLS[0]]
    order = np.lexsort((distance, cell))
    first = np.searchsorted(cell[order], cell[order])
    return np.sort(order[np.arange(len(order)) - first < MOST_IN_CELL])


@dataclass(frozen=True)
class RoadPoints:
    """Points of the road that both images of a group show: the fields of `RoadResiduals` after the first."""

    rays_a: Array  # (n, 3)
    rays_b: Array  # (n, 3)
    weights: Array  # (n, 2, 3)
    beside_m: Array  # (n,)


def grid_ahead(pose: Array) -> Array:
    """(60, 100, 3) points of the road in front of a camera, in the ego frame."""
    yaw = np.arctan2(pose[1, 2], pose[0, 2])
    angle, distance = np.meshgrid(yaw + np.radians(ANGLES_DEG), DISTANCES * pose[2, 3])
    x, y = pose[0, 3] + distance * np.cos(angle), pose[1, 3] + distance * np.sin(angle)
    return np.stack([x, y, np.zeros_like(x)], axis=-1)


def grey_tiles(camera: Camera, image: NDArray[np.uint8], points_camera: Array) -> Array:
    """(tiles, 100) grey values of points (60, 100, 3) in the camera frame; NaN outside of the image."""
    pixels, depth = camera.project(points_camera)
    inside = camera.contains(pixels, depth)
    grey = sampled(image, np.where(inside[..., None], pixels, 0)).astype(np.float64)
    return tiles(np.where(inside, grey, np.nan))


def tiles(values: Array) -> Array:
    """(tiles, 100) of values (60, 100) at the points of `grid_ahead`."""
    (rows, columns), (height, width) = TILES, POINTS
    return values.reshape(rows, height, columns, width).swapaxes(1, 2).reshape(rows * columns, height * width)


def correlation(first: Array, second: Array) -> Array:
    """(tiles,) normalised cross-correlation of tiles (tiles, n); 0 where one of them is not seen whole."""
    a, b = (tiles - tiles.mean(-1, keepdims=True) for tiles in (first, second))
    spread = np.sqrt((a**2).sum(-1) * (b**2).sum(-1))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.nan_to_num((a * b).sum(-1) / spread, nan=0.0, posinf=0.0, neginf=0.0)


def votes(correlations: Array) -> Array:
    """How strongly tiles vote, by their correlations: the more alike, the more, without limit near 1."""
    return np.asarray(-np.log(1.001 - correlations))


def road_points(
    camera: Camera,
    images: tuple[NDArray[np.uint8], NDArray[np.uint8]],
    geometry: GroupGeometry,
    group: int,
    most_px: float,
    least_signal: float = 0.0,
    *,
    grey: bool = False,
) -> RoadPoints:
    """The points of the road in both images of a group (of one camera), at most `most_px` from where they should be.

    least_signal: contrast over noise that a point needs along an axis to count there (see `shared`); 0: all count.
    images: textures, or `grey` pixels, whose texture is then taken at one scale: after a long way it has changed much.
    """
    nothing = RoadPoints(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 2, 3)), np.zeros(0))
    first, second = images
    warped_from = warp(camera, geometry, group)
    if warped_from is None:
        return nothing
    field, road = warped_from
    warped = sampled(second, field)
    if grey:
        first, warped = texture(first, road), texture(warped, road)
    inside = cv2.erode(road.astype(np.uint8), np.ones((WINDOW, WINDOW)))
    at = np.argwhere(inside[::SPACING, ::SPACING] > 0)[:, ::-1].astype(np.float32) * SPACING
    if len(at) < FEWEST:
        return nothing
    flow, kept = flow_at(first, warped, at)
    kept &= np.linalg.norm(flow, axis=-1) < most_px
    at, flow = at[kept], flow[kept]
    if len(at) < FEWEST:
        return nothing
    target = sampled_at(field, at + flow)
    rays_a, rays_b = camera.rays(at), camera.rays(target)
    beside = beside_way(points_of_road(geometry.ego_from_camera_a[group], rays_a), geometry.ego_b_from_ego_a[group])
    weights = ray_weights(camera, first, field, at, target)
    if least_signal:
        weights = shared(first, warped, at, flow, least_signal) @ weights
    return RoadPoints(rays_a, rays_b, weights, beside)


def warp(camera: Camera, geometry: GroupGeometry, group: int) -> tuple[NDArray[np.float32], NDArray[np.bool_]] | None:
    """The map from the first image of a group to the second, over a flat road; None where they share no road.

    Returns (h, w, 2) pixels in the second image, far outside where there is no road to compare, and (h, w) the pixels
    of the first image with road.
    """
    columns, rows = np.arange(0, camera.width + STRIDE, STRIDE), np.arange(0, camera.height + STRIDE, STRIDE)
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).astype(np.float64)
    rays = camera.rays(pixels.reshape(-1, 2))
    pose, motion = geometry.ego_from_camera_a[group], geometry.ego_b_from_ego_a[group]
    points = points_of_road(pose, rays)
    away = np.linalg.norm((points - pose[:3, 3])[:, :2], axis=-1)
    road = (away > NEAREST * pose[2, 3]) & (away < FARTHEST * pose[2, 3]) & (beside_way(points, motion) < WIDEST_M)
    cameras, groups = geometry.ego_from_camera_a, np.full(len(rays), group)
    ahead = rays_of_road_points(geometry, cameras, groups, np.nan_to_num(rays, nan=-1.0))
    target, in_front = camera.project(ahead)
    road &= camera.contains(target, in_front)
    shape = pixels.shape[:2]
    if road.sum() < 4:
        return None
    near = np.nan_to_num(target, nan=OUTSIDE).reshape(*shape, 2).astype(np.float32)
    size = (columns[-1] + STRIDE, rows[-1] + STRIDE)
    matrix = np.array([[1 / STRIDE, 0, 0], [0, 1 / STRIDE, 0]])
    whole, inside = (
        cv2.warpAffine(coarse, matrix, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        for coarse in (near, road.reshape(shape).astype(np.float32))
    )
    cut = np.s_[: camera.height, : camera.width]
    return np.ascontiguousarray(whole[cut]), inside[cut] > 0.999


def points_of_road(pose: Array, rays: Array) -> Array:
    """Points (n, 3) of the plane z = 0 that rays (n, 3) of a camera with a pose (4, 4) hit; NaN above the horizon."""
    directions = rays @ pose[:3, :3].T
    with np.errstate(invalid="ignore", divide="ignore"):
        depth = np.where(directions[:, 2] < -1e-3, pose[2, 3] / -directions[:, 2], np.nan)
    return np.asarray(pose[:3, 3] + depth[:, None] * directions)


def beside_way(points: Array, motion: Array) -> Array:
    """(n,) distance of points (n, 3) of the ego frame from the way of the vehicle, an arc through both positions."""
    ahead = np.linalg.inv(motion)[:2, 3]
    if np.hypot(*ahead) < 1e-6:
        return np.abs(points[:, 1])
    bend = 2 * ahead[1] / (ahead @ ahead)  # of the circle that is tangent to x
    if abs(bend) < 1e-4:
        return np.abs(points[:, 1])
    return np.abs(np.hypot(points[:, 0], points[:, 1] - 1 / bend) - abs(1 / bend))


def flow_at(
    first: NDArray[np.uint8], warped: NDArray[np.uint8], at: NDArray[np.float32]
) -> tuple[Array, NDArray[np.bool_]]:
    """The flow (n, 2) from the first image at points (n, 2), and whether it is believed."""
    start, size, levels = at[:, None], (WINDOW, WINDOW), 2
    there, tracked, _ = cv2.calcOpticalFlowPyrLK(first, warped, start, start.copy(), winSize=size, maxLevel=levels)
    back, again, _ = cv2.calcOpticalFlowPyrLK(warped, first, there, start.copy(), winSize=size, maxLevel=levels)
    returned = np.linalg.norm((back - start)[:, 0], axis=-1) < MOST_BACK_PX
    flow = np.asarray(there - start, dtype=np.float64)[:, 0]
    return flow, (tracked.ravel() > 0) & (again.ravel() > 0) & returned


def sampled(image: NDArray[Any], pixels: NDArray[Any]) -> NDArray[Any]:
    """Values (h, w) or (h, w, D) of an image or a field at pixels (h, w, 2)."""
    x, y = (np.ascontiguousarray(pixels[..., axis], dtype=np.float32) for axis in (0, 1))
    return cv2.remap(image, x, y, cv2.INTER_LINEAR)


def sampled_at(field: NDArray[np.float32], at: NDArray[Any]) -> Array:
    """Values (n, 2) of a field (h, w, 2) at pixels (n, 2)."""
    return sampled(field, at[:, None])[:, 0].astype(np.float64)


def ray_weights(
    camera: Camera, first: NDArray[np.uint8], field: NDArray[np.float32], at: NDArray[Any], target: Array
) -> Array:
    """(n, 2, 3) from an error of a ray in the second image to pixels of the first, weighted by the contrast there."""
    stretch = np.stack([sampled_at(field, at + 2 * axis) - sampled_at(field, at - 2 * axis) for axis in AXES], -1) / 4
    back = np.linalg.pinv(np.nan_to_num(stretch))  # (n, 2, 2), pixels of the first image by those of the second
    along = np.stack([(camera.rays(target + axis) - camera.rays(target - axis)) / 2 for axis in AXES], -1)
    across = np.linalg.pinv(np.nan_to_num(along))  # (n, 2, 3), pixels of the second image by its rays
    return contrast(first, at) @ back @ across


def contrast(image: NDArray[np.uint8], at: NDArray[Any]) -> Array:
    """(n, 2, 2) symmetric, 0 to 1 along each axis of the contrast around pixels (n, 2)."""
    dx, dy = (cv2.Sobel(image, cv2.CV_32F, *order, ksize=3, scale=1 / 8) for order in ((1, 0), (0, 1)))
    products = np.stack([dx * dx, dx * dy, dy * dy], axis=-1)
    mean = cv2.boxFilter(products, -1, (WINDOW, WINDOW))
    columns, rows = np.rint(at).astype(int).T
    xx, xy, yy = mean[rows, columns].astype(np.float64).T
    size, axes = np.linalg.eigh(np.stack([np.stack([xx, xy], -1), np.stack([xy, yy], -1)], -2))
    share = np.sqrt(np.clip(size / FULL_CONTRAST, 0, 1))
    return np.einsum("nij,nj,nkj->nik", axes, share, axes)


def shared(
    first: NDArray[np.uint8], warped: NDArray[np.uint8], at: NDArray[Any], flow: Array, least_signal: float
) -> Array:
    """(n, 2, 2) symmetric, how much of the contrast around pixels (n, 2) both images share: 0 to 1 along each axis.

    Noise has contrast too, but another one in each image. Along an axis that shows little else, such as along the edge
    of a shadow, the flow is where its search began. Twice `least_signal` counts fully.
    """
    around, again = _windows(first, at), _windows(warped, at + flow)
    size, axes = np.linalg.eigh(_gradients(around))
    noise = np.einsum("nji,njk,nki->ni", axes, _gradients(around - again), axes)
    share = np.sqrt(np.clip(size / (noise + LEAST_NOISE) / least_signal - 1, 0, 1))
    return np.einsum("nij,nj,nkj->nik", axes, share, axes)


def _windows(image: NDArray[np.uint8], at: NDArray[Any]) -> Array:
    """(n, WINDOW + 2, WINDOW + 2) grey values around pixels (n, 2)."""
    reach = np.arange(WINDOW + 2) - (WINDOW + 1) // 2
    around = np.stack(np.meshgrid(reach, reach), axis=-1).reshape(1, -1, 2) + at[:, None]
    return sampled(image, around).reshape(len(at), WINDOW + 2, WINDOW + 2).astype(np.float64)


def _gradients(windows: Array) -> Array:
    """(n, 2, 2) mean products of the gradients along x and y of windows (n, h, w), grey levels² per pixel²."""
    along_x = (windows[:, 1:-1, 2:] - windows[:, 1:-1, :-2]) / 2
    along_y = (windows[:, 2:, 1:-1] - windows[:, :-2, 1:-1]) / 2
    slopes = np.stack([along_x, along_y], axis=-1).reshape(len(windows), -1, 2)
    return np.asarray(slopes.swapaxes(1, 2) @ slopes / slopes.shape[1])
