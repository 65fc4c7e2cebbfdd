"""Labels of boxes: their text, and a choice of them that does not overlap."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array
from bevcli.recording.box_lines import ImageLines

LABELS_IN_SCENE = 10  # only the nearest boxes are labelled
LOWEST_LABELLED = 0.05  # of the image's height: smaller boxes are not labelled
LETTER_WIDTH, LETTER_HEIGHT = (
    0.019,
    0.085,
)  # of the image's width and height, for a view that is a third of the screen wide


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
    around = []
    for owner in np.unique(lines.owners):
        points = lines.segments[lines.owners == owner].reshape(-1, 2)
        around.append((int(owner), points.min(0), points.max(0)))
    return sorted(around, key=lambda item: item[1][1] - item[2][1])


def _overlap(a: tuple[float, float, float, float], b: tuple[float, float, float, float]) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]
