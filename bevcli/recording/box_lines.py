"""The edges of 3D boxes in a camera's image, and labels of boxes that do not overlap."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import ArrayLike, NDArray

from bevcli.geometry.boxes import BOX_EDGES, Boxes3D
from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array, apply
from bevcli.recording.components import Components, components, ui_points

NEAR_CLIP_M = 0.2  # lines are cut at this depth; nearer points would project far outside of the image
PIECES_PER_EDGE = 8  # distortion bends edges; they are drawn as this many short lines
FRONT_EDGES = ((0, 7), (3, 4))  # the diagonals of the front face show the heading
_EDGES = np.array((*BOX_EDGES, *FRONT_EDGES))


@dataclass(frozen=True)
class ImageLines:
    """Lines in an image.

    Attributes:
        segments: (M, 2, 2) start and end of each line, pixels, inside the image.
        owners: (M,) the index of the box that each line belongs to; the lines of a box follow each other.
    """

    segments: Array
    owners: NDArray[np.int64]


def lines_in_image(boxes: Boxes3D, camera: Camera, camera_from_boxes: Array) -> ImageLines:
    """The edges and the front diagonals of boxes in a camera's image, cut to the part inside the image.

    camera_from_boxes: (4, 4) from the boxes' frame to the camera frame at the image's time.
    """
    return lines_in_images(boxes, [camera], [camera_from_boxes])[0]


def lines_in_images(boxes: Boxes3D, cameras: Sequence[Camera], cameras_from_boxes: Sequence[Array]) -> list[ImageLines]:
    """As `lines_in_image`, in the image of each of C cameras."""
    corners = boxes.corners()
    of_cameras = np.stack([apply(camera_from_boxes, corners) for camera_from_boxes in cameras_from_boxes])
    camera, before = np.nonzero((of_cameras[..., 2] >= NEAR_CLIP_M).any(-1))
    edges = of_cameras[camera, before][:, _EDGES]  # (K, 14, 2, 3)
    counts = np.bincount(camera, minlength=len(cameras)) * len(_EDGES)
    return cut_to_images(edges.reshape(-1, 2, 3), np.repeat(before, len(_EDGES)), counts, cameras)


def cut_to_images(
    ends: Array, owners: NDArray[np.int64], counts: NDArray[np.int64], cameras: Sequence[Camera]
) -> list[ImageLines]:
    """The parts inside the images of lines (M, 2, 3) with their owners (M,).

    counts: (C,) how many of the lines, one camera after the other, are in the frame of each camera.
    """
    ends, kept = clip_near(ends)
    own_counts = np.bincount(np.repeat(np.arange(len(cameras)), counts)[kept], minlength=len(cameras))
    places = np.cumsum(own_counts)[:-1]
    own_ends, own_owners = np.split(ends[kept], places), np.split(owners[kept], places)
    for i, camera in enumerate(cameras):
        if camera.distortion is not None:
            own_ends[i], own_owners[i] = _cut(own_ends[i]), np.repeat(own_owners[i], PIECES_PER_EDGE)
    pixels = [camera.project(own)[0] for camera, own in zip(cameras, own_ends, strict=True)]
    sizes = np.repeat([(camera.width, camera.height) for camera in cameras], [len(own) for own in pixels], axis=0)
    segments, inside = clip_to_image(np.concatenate(pixels), *sizes.T)
    places = np.cumsum([len(own) for own in pixels])[:-1]
    parts = zip(*(np.split(whole, places) for whole in (segments, inside)), own_owners, strict=True)
    return [ImageLines(own[shown], owner[shown]) for own, shown, owner in parts]


def clip_near(ends: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Lines (M, 2, 3) in the camera frame, cut at depth NEAR_CLIP_M, and which of them (M,) reach beyond it."""
    depth = ends[..., 2]
    before = depth >= NEAR_CLIP_M
    span = depth[:, 1] - depth[:, 0]
    share = np.clip((NEAR_CLIP_M - depth[:, 0]) / np.where(span == 0, 1.0, span), 0, 1)
    cut = ends[:, 0] + share[:, None] * (ends[:, 1] - ends[:, 0])
    return np.where(before[..., None], ends, cut[:, None]), np.asarray(before.any(-1))


def clip_to_image(segments: Array, width: ArrayLike, height: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
    """Lines (M, 2, 2) in pixels, cut at the image's border, and which of them (M,) are inside (Liang and Barsky).

    A line whose start or end is NaN counts as outside. width, height: of the image, or (M,) of the image of each line.
    """
    start, step = segments[:, 0], segments[:, 1] - segments[:, 0]
    slope = np.concatenate([-step, step], axis=-1)  # (M, 4): against left, top, right, bottom
    room = np.concatenate([start, np.stack([width, height], axis=-1) - start], axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = room / slope
    enter = np.max(np.where(slope < 0, share, 0.0), axis=-1, initial=0.0)
    leave = np.min(np.where(slope > 0, share, 1.0), axis=-1, initial=1.0)
    outside = ((slope == 0) & (room < 0)).any(-1)
    kept = (enter < leave) & ~outside & np.isfinite(segments).all((-1, -2))
    shares = np.stack([enter, leave], axis=-1)
    return start[:, None] + shares[..., None] * step[:, None], kept


def _cut(ends: Array) -> Array:
    shares = np.linspace(0, 1, PIECES_PER_EDGE + 1)[:, None]
    points = ends[:, None, 0] + shares * (ends[:, None, 1] - ends[:, None, 0])  # (M, pieces + 1, 3)
    return np.stack([points[:, :-1], points[:, 1:]], axis=2).reshape(-1, 2, 3)


LABELS_IN_SCENE = 10  # only the nearest boxes are labelled
LOWEST_LABELLED = 0.05  # of the image's height: smaller boxes are not labelled
# Of the image's width and height, for a view that is a third of the screen wide.
LETTER_WIDTH, LETTER_HEIGHT = 0.019, 0.085
UNSEEN = ui_points(0.01)  # of a point that shows only its label


def labels_2d(places: ArrayLike, texts: list[str], **options: Any) -> Components:
    """Texts at places (L, 2), in the units of their view. options: of `rr.Points2D`."""
    positions = np.asarray(places)
    return components(rr.Points2D, positions=positions, labels=texts, radii=UNSEEN, show_labels=True, **options)


def box_labels(boxes: Boxes3D) -> list[str]:
    """The text of each label: "car 0.83", "car" where boxes have no scores, "car #12 0.83" for a box of track 12."""
    texts = [str(name).replace("_", " ") for name in boxes.classes]
    if boxes.instances is not None:
        texts = [f"{text} #{track}" if track else text for text, track in zip(texts, boxes.instances, strict=True)]
    if boxes.scores is None:
        return texts
    return [f"{text} {score:.2f}" for text, score in zip(texts, boxes.scores, strict=True)]


def labels_in_scene(boxes: Boxes3D, ego_xy: Array) -> list[str]:
    """Labels for the boxes nearest to ego_xy (2,), "" for the others. boxes: in the same frame, metres."""
    away = np.linalg.norm(boxes.centers[:, :2] - ego_xy, axis=-1)
    near = set(np.argsort(away)[:LABELS_IN_SCENE].tolist())
    return [text if i in near else "" for i, text in enumerate(box_labels(boxes))]


def labels_in_image(lines: ImageLines, texts: list[str], width: int, height: int) -> tuple[Array, NDArray[np.int64]]:
    """Positions of labels above their boxes. The largest boxes are labelled first; no label covers another.

    lines: the boxes' lines in an image of this width and height. texts: the label of each box.

    Returns the centres of the labels (L, 2), pixels, and the boxes (L,) that they belong to.
    """
    taken: list[tuple[float, float, float, float]] = []
    centers, owners = [], []
    for owner, low, high in _by_height(lines):
        if high[1] - low[1] < LOWEST_LABELLED * height:
            break
        half = len(texts[owner]) * LETTER_WIDTH * width / 2
        middle = float(np.clip((low[0] + high[0]) / 2, half, width - half))
        area = (middle - half, low[1] - LETTER_HEIGHT * height, middle + half, low[1])
        if not any(_overlap(area, other) for other in taken):
            taken.append(area)
            centers.append((middle, low[1] - LETTER_HEIGHT * height / 2))
            owners.append(owner)
    return np.array(centers).reshape(-1, 2), np.array(owners, dtype=np.int64)


def _by_height(lines: ImageLines) -> list[tuple[int, Array, Array]]:
    """Each box in the image with its bounding rectangle's corners (2,), (2,), the highest rectangle first."""
    owners, first = np.unique(lines.owners, return_index=True)  # the lines of a box follow each other
    low = np.minimum.reduceat(lines.segments.min(1), first) if len(first) else ()
    high = np.maximum.reduceat(lines.segments.max(1), first) if len(first) else ()
    around = list(zip(owners.tolist(), low, high, strict=True))
    return sorted(around, key=lambda item: item[1][1] - item[2][1])


def _overlap(a: tuple[float, float, float, float], b: tuple[float, float, float, float]) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]
