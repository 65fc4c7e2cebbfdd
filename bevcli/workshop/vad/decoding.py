"""The outputs of a VAD, decoded: boxes with futures, lines, planned paths; and attention to objects and lines."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from torch import Tensor

from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array
from bevcli.model.box_coding import best_boxes, boxes_of_codes
from bevcli.model.decoder import best_classes
from bevcli.model.step import ModelOutputs, SceneAttention
from bevcli.workshop.vad.config import VADConfig
from bevcli.workshop.vad.line_decoder import LineOutputs
from bevcli.workshop.vad.map_lines import MapLines
from bevcli.workshop.vad.motion_head import MotionOutputs
from bevcli.workshop.vad.plan import Plan

MIN_SCORE = 0.3  # of the object whose motion is explained, where any object has it


@dataclass(frozen=True, kw_only=True)
class VADOutputs(ModelOutputs):
    """The outputs of one step.

    Attributes:
        lines: of the map.
        motion: the futures of the object queries.
        plan: (B, commands, T, 2) movement of the vehicle in each step along x and y of the bev frame, metres.
    """

    lines: LineOutputs
    motion: MotionOutputs
    plan: Tensor

    @property
    def further(self) -> dict[str, Tensor]:
        return {
            "line_class_logits": self.lines.class_logits[-1],
            "line_points": self.lines.points[-1],
            "future_offsets": self.motion.offsets,
            "mode_logits": self.motion.mode_logits,
            "plan_offsets": self.plan,
        }

    def last_layers(self) -> Self:
        """See `ModelOutputs`. Features, which only the network uses, are left out."""
        lines, none = self.lines, self.plan[:0]
        last = LineOutputs(lines.class_logits[-1:], lines.points[-1:], none)
        return replace(super().last_layers(), lines=last, motion=replace(self.motion, features=none))


def decode_futures(outputs: VADOutputs, config: VADConfig) -> Boxes3D:
    """The boxes of `bevcli.model.box_coding.decode`, with futures: the places of each object's centre in each mode."""
    best = best_boxes(outputs.class_logits[-1], outputs.box_codes[-1], config)
    boxes, queries = best.decoded(config.classes), best.query[0]
    offsets = _array(outputs.motion.offsets[0, queries])  # (K, M, T, 2)
    places = boxes.centers[:, None, None, :2] + offsets.cumsum(2)
    seconds = np.broadcast_to(np.array(config.future_times_s)[:, None], (*places.shape[:3], 1))
    scores = _array(outputs.motion.mode_logits[0, queries].sigmoid())
    return replace(boxes, futures=np.concatenate([seconds, places], axis=-1), future_scores=scores)


def decode_lines(outputs: VADOutputs, config: VADConfig) -> MapLines:
    """The line_decoder.max_lines lines with the best scores, by falling score, bev frame; see `best_classes`."""
    decoder = config.line_decoder
    scores, queries, labels = (each[0] for each in best_classes(outputs.lines.class_logits[-1], decoder.max_lines))
    points = line_places(outputs.lines.points[-1, 0, queries], config)  # (K, P, 2)
    return MapLines(tuple(points), np.asarray(decoder.classes)[labels.cpu().numpy()], _array(scores))


def line_places(points: Tensor, config: VADConfig) -> Array:
    """Points of lines (..., 2), 0 to 1 over the range -> metres, bev frame."""
    (x0, x1), (y0, y1) = config.bev_grid.x_range_m, config.bev_grid.y_range_m
    return _array(points) * (x1 - x0, y1 - y0) + (x0, y0)


def decode_plan(outputs: VADOutputs, config: VADConfig) -> Plan:
    """The planned paths, bev frame."""
    return Plan(config.commands, _array(outputs.plan[0]).cumsum(1), np.array(config.future_times_s))


def scene_attentions(
    outputs: VADOutputs, weights: Sequence[Tensor], config: VADConfig, place: tuple[float, float]
) -> dict[str, SceneAttention]:
    """Attention of the planner, and of the object nearest to a place, to the objects and the lines.

    That of the object is the mean over its modes, the sum over modes of the others.

    Args:
        weights: of the planner to objects (1, 1, Q) and to lines (1, 1, N); of the motion head to modes of objects
            (1, Q·M, Q·M) and to lines (Q, M, N + 1), the last one of "no line".
        place: x and y, metres, bev frame.
    """
    plan_to_objects, plan_to_lines, to_objects, to_lines = weights
    objects, lines = _objects(outputs, config), _lines(outputs, config)
    paths = _paths(outputs.plan[0], np.zeros(2))
    attending = _nearest(objects, place)
    of_objects = to_objects[0].unflatten(0, (len(objects), -1))[attending].unflatten(-1, (len(objects), -1))
    of_lines = _array(to_lines[attending].mean(0))
    motion = SceneAttention(
        objects,
        _array(of_objects.sum(-1).mean(0)),
        lines,
        of_lines[:-1],
        _paths(outputs.motion.offsets[0, attending], objects.centers[attending, :2]),
        best=int(outputs.motion.mode_logits[0, attending].argmax()),
        no_line=float(of_lines[-1]),
        attending=attending,
    )
    plan = SceneAttention(objects, _array(plan_to_objects[0, 0]), lines, _array(plan_to_lines[0, 0]), paths)
    return {"plan": plan, "motion": motion}


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
