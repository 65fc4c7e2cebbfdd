"""Projects the edges of 3D boxes into a camera's image, with lens distortion; clips them at the image's border."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.boxes import BOX_EDGES, Boxes3D
from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array, apply

NEAR_CLIP_M = 0.2  # lines are cut at this depth; nearer points would project far outside of the image
PIECES_PER_EDGE = 8  # distortion bends edges; they are drawn as this many short lines
FRONT_EDGES = ((0, 7), (3, 4))  # the diagonals of the front face show the heading
_EDGES = np.array((*BOX_EDGES, *FRONT_EDGES))


@dataclass(frozen=True)
class ImageLines:
    """Lines in an image.

    Attributes:
        segments: (M, 2, 2) start and end of each line, pixels, inside the image.
        owners: (M,) the index of the box that each line belongs to.
    """

    segments: Array
    owners: NDArray[np.int64]


def lines_in_image(boxes: Boxes3D, camera: Camera, camera_from_boxes: Array) -> ImageLines:
    """The edges and the front diagonals of boxes in a camera's image, cut to the part inside the image.

    camera_from_boxes: (4, 4) from the boxes' frame to the camera frame at the image's time.
    """
    corners = apply(camera_from_boxes, boxes.corners())  # (N, 8, 3)
    edges = corners[:, _EDGES]  # (N, 14, 2, 3)
    owners = np.repeat(np.arange(len(boxes)), len(_EDGES))
    ends, kept = clip_near(edges.reshape(-1, 2, 3))
    ends, owners = ends[kept], owners[kept]
    if camera.distortion is not None:
        ends, owners = _cut(ends, PIECES_PER_EDGE), np.repeat(owners, PIECES_PER_EDGE)
    pixels, _ = camera.project(ends)
    segments, inside = clip_to_image(pixels, camera.width, camera.height)
    return ImageLines(segments[inside], owners[inside])


def clip_near(ends: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Lines (M, 2, 3) in the camera frame, cut at depth NEAR_CLIP_M, and which of them (M,) reach beyond it."""
    depth = ends[..., 2]
    before = depth >= NEAR_CLIP_M
    span = depth[:, 1] - depth[:, 0]
    share = np.clip((NEAR_CLIP_M - depth[:, 0]) / np.where(span == 0, 1.0, span), 0, 1)
    cut = ends[:, 0] + share[:, None] * (ends[:, 1] - ends[:, 0])
    return np.where(before[..., None], ends, cut[:, None]), np.asarray(before.any(-1))


def clip_to_image(segments: Array, width: int, height: int) -> tuple[Array, NDArray[np.bool_]]:
    """Lines (M, 2, 2) in pixels, cut at the image's border, and which of them (M,) are inside (Liang and Barsky).

    A line whose start or end is NaN counts as outside.
    """
    start, step = segments[:, 0], segments[:, 1] - segments[:, 0]
    slope = np.concatenate([-step, step], axis=-1)  # (M, 4): against left, top, right, bottom
    room = np.concatenate([start, np.array([width, height]) - start], axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = room / slope
    enter = np.max(np.where(slope < 0, share, 0.0), axis=-1, initial=0.0)
    leave = np.min(np.where(slope > 0, share, 1.0), axis=-1, initial=1.0)
    outside = ((slope == 0) & (room < 0)).any(-1)
    kept = (enter < leave) & ~outside & np.isfinite(segments).all((-1, -2))
    shares = np.stack([enter, leave], axis=-1)
    return start[:, None] + shares[..., None] * step[:, None], kept


def _cut(ends: Array, pieces: int) -> Array:
    shares = np.linspace(0, 1, pieces + 1)[:, None]
    points = ends[:, None, 0] + shares * (ends[:, None, 1] - ends[:, None, 0])  # (M, pieces + 1, 3)
    return np.stack([points[:, :-1], points[:, 1:]], axis=2).reshape(-1, 2, 3)
