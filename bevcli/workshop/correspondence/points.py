"""Grey images of one size, and the points that two of them show: SIFT features, and those that match.

Features are found an image, and matched two images, so that a caller keeps no more images than it wants.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array

WIDTH, MOST_ENLARGED = 1000, 2  # pixels: all images are brought to this width; largest factor
THREADS = min(os.cpu_count() or 1, 8)  # each needs about 150 MB while it finds features
DARKEST = 4  # grey levels of standard deviation; an image with less shows nothing
SMOOTHING, COARSE = 1.2, 35  # pixels: finer structure is noise, coarser is light and shade
FLAT = 1.0  # grey levels, a weaker structure is noise


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
