"""Attention of the planner, and of one object's motion, to the objects and the lines of a VAD."""

from collections.abc import Sequence

import numpy as np
from torch import Tensor

from bevcli.frame import MapLines
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array
from bevcli.model.box_coding import boxes_of_codes
from bevcli.model.scene_attention import SceneAttention
from bevcli.model.vad.config import VADConfig
from bevcli.model.vad.decoding import VADOutputs, line_places

MIN_SCORE = 0.3  # of the object whose motion is explained, where any object has it


def plan_attention(outputs: VADOutputs, weights: Sequence[Tensor], config: VADConfig) -> SceneAttention:
    """Attention of the planner. weights: to objects (1, 1, Q), and to lines (1, 1, N)."""
    to_objects, to_lines = weights
    paths = _paths(outputs.plan[0], np.zeros(2))
    objects, lines = _objects(outputs, config), _lines(outputs, config)
    return SceneAttention(objects, _array(to_objects[0, 0]), lines, _array(to_lines[0, 0]), paths)


def motion_attention(
    outputs: VADOutputs, weights: Sequence[Tensor], config: VADConfig, place: tuple[float, float]
) -> SceneAttention:
    """Attention of the object nearest to a place: the mean over its modes, the sum over modes of the others.

    Args:
        outputs: of the step.
        weights: to modes of objects (1, Q·M, Q·M), and to lines (Q, M, N + 1), the last one of "no line".
        config: of the model.
        place: x and y, metres, bev frame.
    """
    to_objects, to_lines = weights
    objects = _objects(outputs, config)
    attending = _nearest(objects, place)
    of_objects = to_objects[0].unflatten(0, (len(objects), -1))[attending].unflatten(-1, (len(objects), -1))
    of_lines = _array(to_lines[attending].mean(0))
    return SceneAttention(
        objects,
        _array(of_objects.sum(-1).mean(0)),
        _lines(outputs, config),
        of_lines[:-1],
        _paths(outputs.motion.offsets[0, attending], objects.centers[attending, :2]),
        best=int(outputs.motion.mode_logits[0, attending].argmax()),
        no_line=float(of_lines[-1]),
        attending=attending,
    )


def _objects(outputs: VADOutputs, config: VADConfig) -> Boxes3D:
    scores, labels = outputs.class_logits[-1, 0].sigmoid().max(-1)
    classes = np.asarray(config.classes)[labels.cpu().numpy()]
    return boxes_of_codes(_array(outputs.box_codes[-1, 0]), classes, _array(scores))


def _lines(outputs: VADOutputs, config: VADConfig) -> MapLines:
    """All lines, also those that `decode_lines` leaves out: the planner attends to all."""
    scores, labels = outputs.lines.class_logits[-1, 0].sigmoid().max(-1)
    classes = np.asarray(config.line_decoder.classes)[labels.cpu().numpy()]
    return MapLines(tuple(line_places(outputs.lines.points[-1, 0], config)), classes, _array(scores))


def _nearest(objects: Boxes3D, place: tuple[float, float]) -> int:
    assert objects.scores is not None
    distances = np.linalg.norm(objects.centers[:, :2] - place, axis=-1)
    is_sure = objects.scores >= MIN_SCORE
    return int(np.where(is_sure | ~is_sure.any(), distances, np.inf).argmin())


def _paths(offsets: Tensor, start: Array) -> Array:
    """Movements (K, T, 2) -> places (K, T + 1, 2)."""
    moved = _array(offsets).cumsum(1)
    return start + np.concatenate([np.zeros_like(moved[:, :1]), moved], axis=1)


def _array(values: Tensor) -> Array:
    array: Array = values.double().cpu().numpy()
    return array
