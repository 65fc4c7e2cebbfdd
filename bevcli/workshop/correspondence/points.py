"""Points that two images show: SIFT features, and those that match. What moves by itself is left out.

Features are found an image, and matched two images, so that a caller keeps no more images than it wants.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array
from bevcli.workshop.correspondence.images import GreyImage

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
