"""The outputs of a VAD, and the boxes with futures, lines and planned paths that are decoded from them."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from torch import Tensor

from bevcli.frame import MapLines, Plan
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array
from bevcli.model.box_coding import best_boxes, decode
from bevcli.model.step import ModelOutputs
from bevcli.model.vad.config import VADConfig
from bevcli.model.vad.line_decoder import LineOutputs
from bevcli.model.vad.motion_head import MotionOutputs


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

    def last_layers(self) -> Self:
        """See `ModelOutputs`. Features, which only the network uses, are left out."""
        lines, none = self.lines, self.plan[:0]
        last = LineOutputs(lines.class_logits[-1:], lines.points[-1:], none)
        return replace(super().last_layers(), lines=last, motion=replace(self.motion, features=none))


def decode_futures(outputs: VADOutputs, config: VADConfig) -> Boxes3D:
    """The boxes of `bevcli.model.box_coding.decode`, with futures: the places of each object's centre in each mode."""
    boxes = decode(outputs, config)[0]
    queries = best_boxes(outputs.class_logits[-1], outputs.box_codes[-1], config).query[0]
    offsets = outputs.motion.offsets[0, queries].double().cpu().numpy()  # (K, M, T, 2)
    places = boxes.centers[:, None, None, :2] + offsets.cumsum(2)
    seconds = np.broadcast_to(step_times(config)[:, None], (*places.shape[:3], 1))
    scores = outputs.motion.mode_logits[0, queries].sigmoid().double().cpu().numpy()
    return replace(boxes, futures=np.concatenate([seconds, places], axis=-1), future_scores=scores)


def decode_lines(outputs: VADOutputs, config: VADConfig) -> MapLines:
    """The line_decoder.max_lines lines with the best scores, by falling score, bev frame.

    A query gives one line for each of its classes that is among the best scores.
    """
    decoder = config.line_decoder
    scores = outputs.lines.class_logits[-1, 0].sigmoid().flatten()  # (N · classes,)
    best, index = scores.topk(min(decoder.max_lines, len(scores)))
    points = line_places(outputs.lines.points[-1, 0, index // len(decoder.classes)], config)  # (K, P, 2)
    classes = np.asarray(decoder.classes)[(index % len(decoder.classes)).cpu().numpy()]
    return MapLines(tuple(points), classes, best.double().cpu().numpy())


def line_places(points: Tensor, config: VADConfig) -> Array:
    """Points of lines (..., 2), 0 to 1 over the range -> metres, bev frame."""
    (x0, x1), (y0, y1) = config.bev_grid.x_range_m, config.bev_grid.y_range_m
    places: Array = points.double().cpu().numpy() * (x1 - x0, y1 - y0) + (x0, y0)
    return places


def decode_plan(outputs: VADOutputs, config: VADConfig) -> Plan:
    """The planned paths, bev frame."""
    return Plan(config.commands, outputs.plan[0].double().cpu().numpy().cumsum(1), step_times(config))


def step_times(config: VADConfig) -> Array:
    """(T,) seconds from the frame's time to the end of each step."""
    return np.array(config.future_times_s)
