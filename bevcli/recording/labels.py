"""Labels of boxes: what they say, and which of them are shown so that they do not cover each other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array
from bevcli.recording.box_lines import ImageLines

LABELS_IN_SCENE = 10  # the nearest boxes; the others show their colour
LOWEST_LABELLED = 0.05  # of the image's height: smaller boxes show their colour only
LETTER_WIDTH, LETTER_HEIGHT = 0.019, 0.085  # of the image's width and height, where the view is a third of the screen


def box_labels(boxes: Boxes3D) -> list[str]:
    """ "car 0.83" for each, without the score where there is none."""
    names = [str(name).replace("_", " ") for name in boxes.classes]
    if boxes.scores is None:
        return names
    return [f"{name} {score:.2f}" for name, score in zip(names, boxes.scores, strict=True)]


def labels_in_scene(boxes: Boxes3D, ego_xy: Array) -> list[str]:
    """A label for the boxes nearest to ego_xy (2,), "" for the others."""
    away = np.linalg.norm(boxes.centers[:, :2] - ego_xy, axis=-1)
    near = set(np.argsort(away)[:LABELS_IN_SCENE].tolist())
    return [text if i in near else "" for i, text in enumerate(box_labels(boxes))]


def labels_in_image(lines: ImageLines, texts: list[str], width: int, height: int) -> tuple[Array, NDArray[np.int64]]:
    """Where labels stand, (L, 2) pixels, over the boxes (L,) they belong to: the largest first, none over another."""
    taken: list[tuple[float, float, float, float]] = []
    places, owners = [], []
    for owner, low, high in _by_height(lines):
        if high[1] - low[1] < LOWEST_LABELLED * height:
            break
        half = len(texts[owner]) * LETTER_WIDTH * width / 2
        middle = float(np.clip((low[0] + high[0]) / 2, half, width - half))
        area = (middle - half, low[1] - LETTER_HEIGHT * height, middle + half, low[1])
        if not any(_overlap(area, other) for other in taken):
            taken.append(area)
            places.append((middle, low[1] - LETTER_HEIGHT * height / 2))
            owners.append(owner)
    return np.array(places).reshape(-1, 2), np.array(owners, dtype=np.int64)


def _by_height(lines: ImageLines) -> list[tuple[int, Array, Array]]:
    """Each box in the image with the corners of the rectangle around it, the highest first."""
    around = []
    for owner in np.unique(lines.owners):
        points = lines.segments[lines.owners == owner].reshape(-1, 2)
        around.append((int(owner), points.min(0), points.max(0)))
    return sorted(around, key=lambda item: item[1][1] - item[2][1])


def _overlap(a: tuple[float, float, float, float], b: tuple[float, float, float, float]) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]
