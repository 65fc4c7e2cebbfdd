"""The outputs of a VAD, decoded: boxes with futures, lines, planned paths."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from torch import Tensor

from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array
from bevcli.model.box_coding import best_boxes
from bevcli.model.decoder import best_classes
from bevcli.model.step import ModelOutputs
from bevcli.workshop.vad.config import VADConfig
from bevcli.workshop.vad.line_decoder import LineOutputs
from bevcli.workshop.vad.map_lines import MapLines
from bevcli.workshop.vad.motion_head import MotionOutputs
from bevcli.workshop.vad.plan import Plan


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
    offsets = as_array(outputs.motion.offsets[0, queries])  # (K, M, T, 2)
    places = boxes.centers[:, None, None, :2] + offsets.cumsum(2)
    seconds = np.broadcast_to(np.array(config.future_times_s)[:, None], (*places.shape[:3], 1))
    scores = as_array(outputs.motion.mode_logits[0, queries].sigmoid())
    return replace(boxes, futures=np.concatenate([seconds, places], axis=-1), future_scores=scores)


def decode_lines(outputs: VADOutputs, config: VADConfig) -> MapLines:
    """The line_decoder.max_lines lines with the best scores, by falling score, bev frame; see `best_classes`."""
    decoder = config.line_decoder
    scores, queries, labels = (each[0] for each in best_classes(outputs.lines.class_logits[-1], decoder.max_lines))
    points = line_places(outputs.lines.points[-1, 0, queries], config)  # (K, P, 2)
    return MapLines(tuple(points), np.asarray(decoder.classes)[labels.cpu().numpy()], as_array(scores))


def line_places(points: Tensor, config: VADConfig) -> Array:
    """Points of lines (..., 2), 0 to 1 over the range -> metres, bev frame."""
    (x0, x1), (y0, y1) = config.bev_grid.x_range_m, config.bev_grid.y_range_m
    return as_array(points) * (x1 - x0, y1 - y0) + (x0, y0)


def decode_plan(outputs: VADOutputs, config: VADConfig) -> Plan:
    """The planned paths, bev frame."""
    return Plan(config.commands, as_array(outputs.plan[0]).cumsum(1), np.array(config.future_times_s))


def as_array(values: Tensor) -> Array:
    array: Array = values.double().cpu().numpy()
    return array
