"""Writes boxes into a recording: predictions and ground truth, in the 3D scene and in the BEV view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr

from bevcli.geometry.boxes import CLASSES, Boxes3D
from bevcli.geometry.transforms import Array
from bevcli.recording import entities
from bevcli.recording.colors import (
    DUPLICATE_COLOR,
    FALSE_COLOR,
    GROUND_TRUTH_COLOR,
    MISSED_COLOR,
    OTHER_COLOR,
    class_color,
)
from bevcli.recording.labels import labels_in_scene
from bevcli.recording.strips import strips_2d

MOVING_M_S = 0.5  # slower objects get no velocity arrow
THIN, THICK = rr.Radius.ui_points(0.8), rr.Radius.ui_points(1.6)


def box_colors(boxes: Boxes3D, class_names: Sequence[str]) -> np.ndarray:
    """(N, 3) uint8 RGB: the colour of each box's class."""
    indices = {name: index for index, name in enumerate(class_names)}
    colors = {name: class_color(name, indices.get(name, len(indices))) for name in np.unique(boxes.classes)}
    return np.array([colors[name] for name in boxes.classes], dtype=np.uint8).reshape(-1, 3)


@dataclass(frozen=True)
class Marks:
    """Which of N predicted boxes are marked as wrong.

    Attributes:
        false: (N,) bool, the false positives: crossed out in red.
        duplicate: (N,) bool, a second box on an object: one grey diagonal.
    """

    false: np.ndarray
    duplicate: np.ndarray


def log_boxes_3d(
    stream: rr.RecordingStream, boxes: Boxes3D, marks: Marks, class_names: Sequence[str], ego_xy: Array
) -> None:
    """Writes predicted boxes into the scene: boxes, velocity arrows, marks of false positives and duplicates.

    boxes: in the recording's world. ego_xy: (2,) the vehicle's position; the boxes nearest to it get labels.
    """
    ids = [1 + list(class_names).index(name) if name in class_names else 0 for name in boxes.classes]
    labels = labels_in_scene(boxes, ego_xy)
    archetype = rr.Boxes3D(**_shape(boxes), class_ids=ids, labels=labels, show_labels=True, radii=THICK)
    facts = rr.AnyValues(
        score=np.ones(len(boxes)) if boxes.scores is None else boxes.scores,
        velocity_x=boxes.velocities[:, 0],
        velocity_y=boxes.velocities[:, 1],
        name=_names(boxes),
        **({} if boxes.instances is None else {"track": pa.array(boxes.instances.tolist(), pa.utf8())}),
    )
    stream.log(entities.BOXES, archetype, facts)
    moving = np.linalg.norm(boxes.velocities, axis=-1) > MOVING_M_S
    arrows = rr.Arrows3D(
        vectors=np.column_stack([boxes.velocities[moving], np.zeros(moving.sum())]),
        origins=boxes.centers[moving],
        colors=box_colors(boxes[moving], class_names),
        radii=rr.Radius.ui_points(1.2),
    )
    stream.log(entities.VELOCITY, arrows)
    stream.log(
        entities.FALSE_BOXES,
        rr.LineStrips3D(_crosses(boxes[marks.false]).astype(np.float32), colors=FALSE_COLOR, radii=THICK),
    )
    diagonals = _crosses(boxes[marks.duplicate])[::2].astype(np.float32)
    stream.log(entities.DUPLICATES, rr.LineStrips3D(diagonals, colors=DUPLICATE_COLOR, radii=THICK))


def other_classes(truth: Boxes3D, class_names: Sequence[str]) -> np.ndarray:
    """(M,) bool, whether a ground-truth box has a class that neither nuScenes nor the model has: it is never missed."""
    return ~np.isin(truth.classes, (*CLASSES, *class_names))


def ground_truth_colors(found: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(M, 3) uint8 colours of ground-truth boxes: pale where found, red where missed, grey for other classes.

    found: (M,) bool. other: (M,) bool, classes that are not among the model's.
    """
    colors = np.where(found[:, None], GROUND_TRUTH_COLOR, MISSED_COLOR)
    return np.where(other[:, None], OTHER_COLOR, colors).astype(np.uint8).reshape(-1, 3)


def log_ground_truth_3d(stream: rr.RecordingStream, truth: Boxes3D, found: np.ndarray, colors: np.ndarray) -> None:
    """Writes ground-truth boxes (in the recording's world) into the scene; found and missed ones are two entities.

    found: (M,) bool. colors: (M, 3) uint8.
    """
    pale = rr.Boxes3D(**_shape(truth[found]), colors=_with_alpha(colors[found], 150), radii=THIN)
    stream.log(entities.GROUND_TRUTH, pale, rr.AnyValues(name=_names(truth[found])))
    missed = truth[~found]
    red = rr.Boxes3D(**_shape(missed), colors=MISSED_COLOR, radii=THIN)
    stream.log(entities.MISSED, red, rr.AnyValues(name=_names(missed)))


def log_boxes_bev(stream: rr.RecordingStream, boxes: Boxes3D, marks: Marks, class_names: Sequence[str]) -> None:
    """Writes predicted boxes (in the bev frame) into the BEV view."""
    colors = box_colors(boxes, class_names)
    outlines, headings = footprints(boxes)
    strips = strips_2d([*outlines, *headings])
    doubled = np.concatenate([colors, colors])
    stream.log(entities.BEV_BOXES, rr.LineStrips2D(strips, colors=doubled, radii=THICK, draw_order=30))
    moving = np.linalg.norm(boxes.velocities, axis=-1) > MOVING_M_S
    arrows = rr.Arrows2D(
        vectors=boxes.velocities[moving] * (1, -1),
        origins=boxes.centers[moving, :2] * (1, -1),
        colors=colors[moving],
        radii=rr.Radius.ui_points(1.0),
        draw_order=31,
    )
    stream.log(entities.BEV_VELOCITY, arrows)
    crosses = (_crosses(boxes[marks.false])[..., :2] * (1, -1)).astype(np.float32)
    stream.log(entities.BEV_FALSE, rr.LineStrips2D(crosses, colors=FALSE_COLOR, radii=THIN, draw_order=32))
    diagonals = (_crosses(boxes[marks.duplicate])[::2, :, :2] * (1, -1)).astype(np.float32)
    stream.log(entities.BEV_DUPLICATES, rr.LineStrips2D(diagonals, colors=DUPLICATE_COLOR, radii=THIN, draw_order=32))


def log_ground_truth_bev(stream: rr.RecordingStream, truth: Boxes3D, found: np.ndarray, colors: np.ndarray) -> None:
    """Writes ground-truth boxes (in the bev frame) into the BEV view, as `log_ground_truth_3d`."""
    for entity, chosen in ((entities.BEV_GROUND_TRUTH, found), (entities.BEV_MISSED, ~found)):
        outlines, headings = footprints(truth[chosen])
        doubled = np.tile(_with_alpha(colors[chosen], 200), (2, 1))
        strips = strips_2d([*outlines, *headings])
        stream.log(entity, rr.LineStrips2D(strips, colors=doubled, radii=THIN, draw_order=20))


def _with_alpha(colors: np.ndarray, alpha: int) -> np.ndarray:
    return np.column_stack([colors, np.full(len(colors), alpha, dtype=np.uint8)])


def footprints(boxes: Boxes3D) -> tuple[Array, Array]:
    """Boxes of the bev frame in the flat BEV image (x to the right, -y down, metres).

    Returns closed outlines (N, 5, 2), and lines from the centre to the front (N, 2, 2).
    """
    ground = boxes.corners()[:, :4, :2] * (1, -1)
    outlines = np.concatenate([ground, ground[:, :1]], axis=1)
    front = (ground[:, 0] + ground[:, 3]) / 2
    return outlines, np.stack([ground.mean(1), front], axis=1)


def _shape(boxes: Boxes3D) -> dict[str, Any]:
    halves = boxes.yaws / 2
    zeros = np.zeros(len(boxes))
    quaternions = np.stack([zeros, zeros, np.sin(halves), np.cos(halves)], axis=-1)  # rerun's order is x, y, z, w
    return {
        "centers": boxes.centers,
        "half_sizes": boxes.sizes_lwh / 2,
        "quaternions": quaternions,
        "fill_mode": "majorwireframe",
    }


def _names(boxes: Boxes3D) -> pa.Array:
    return pa.array([str(name) for name in boxes.classes], pa.utf8())  # typed, so that an empty list is a value too


def _crosses(boxes: Boxes3D) -> Array:
    """(2 N, 2, 3): the two diagonals of each box's top face."""
    tops = boxes.corners()[:, 4:]
    return tops[:, [[0, 2], [1, 3]]].reshape(-1, 2, 3)
