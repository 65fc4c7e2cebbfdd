"""The attention of a VAD to the objects and the lines of a scene, for figures."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from bevcli.frame import MapLines
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array
from bevcli.model.box_coding import boxes_of_codes
from bevcli.workshop.vad.config import VADConfig
from bevcli.workshop.vad.decoding import VADOutputs, as_array, line_places
from bevcli.workshop.vad.motion_head import AttentionLayer
from bevcli.workshop.vad.vad import VAD

MIN_SCORE = 0.3  # of the object whose motion is explained, where any object has it


@dataclass(frozen=True)
class SceneAttention:
    """Attention to Q objects and N lines, the mean over heads. Places are in metres, bev frame.

    Attributes:
        objects: one box for each object query, with its best class.
        object_weights: (Q,), which sum to 1.
        lines: of all line queries, each with its best class.
        line_weights: (N,), which sum to 1 together with `no_line`.
        paths: (K, T + 1, 2), that come of the attention: planned paths, or futures of the attending object.
        best: index of the path that counts; None where it is not known.
        no_line: weight of the entry that stands for no line; 0 for a part without one.
        attending: index of the object that attends; None for the own vehicle.
    """

    objects: Boxes3D
    object_weights: Array
    lines: MapLines
    line_weights: Array
    paths: Array
    best: int | None = None
    no_line: float = 0.0
    attending: int | None = None


def scene_attentions(model: VAD, outputs: VADOutputs, place: tuple[float, float]) -> dict[str, SceneAttention]:
    """Attention of the planner, and of the object nearest to a place, to the objects and the lines.

    That of the object is the mean over its modes, the sum over modes of the others. The heads run again, because
    outputs have no attention weights.

    outputs: of a batch of one. place: x and y, metres, bev frame.
    """
    config, planner, motion_head = model.config, model.planner, model.motion_head
    layers = (planner.agent_attention, planner.line_attention, motion_head.agent_attention, motion_head.line_attention)
    with attention_weights(*layers) as weights:
        model.detect(outputs.bev)
    # Of the planner (1, 1, Q) and (1, 1, N); of the modes of objects (1, Q·M, Q·M) and (Q, M, N + 1), last "no line".
    plan_to_objects, plan_to_lines, to_objects, to_lines = (weights[layer] for layer in layers)
    objects, lines = _objects(outputs, config), _lines(outputs, config)
    paths = _paths(outputs.plan[0], np.zeros(2))
    attending = _nearest(objects, place)
    of_objects = to_objects[0].unflatten(0, (len(objects), -1))[attending].unflatten(-1, (len(objects), -1))
    of_lines = as_array(to_lines[attending].mean(0))
    motion = SceneAttention(
        objects,
        as_array(of_objects.sum(-1).mean(0)),
        lines,
        of_lines[:-1],
        _paths(outputs.motion.offsets[0, attending], objects.centers[attending, :2]),
        best=int(outputs.motion.mode_logits[0, attending].argmax()),
        no_line=float(of_lines[-1]),
        attending=attending,
    )
    plan = SceneAttention(objects, as_array(plan_to_objects[0, 0]), lines, as_array(plan_to_lines[0, 0]), paths)
    return {"plan": plan, "motion": motion}


def _objects(outputs: VADOutputs, config: VADConfig) -> Boxes3D:
    scores, labels = outputs.class_logits[-1, 0].sigmoid().max(-1)
    classes = np.asarray(config.classes)[labels.cpu().numpy()]
    return boxes_of_codes(as_array(outputs.box_codes[-1, 0]), classes, as_array(scores))


def _lines(outputs: VADOutputs, config: VADConfig) -> MapLines:
    """All lines, also those that `decode_lines` leaves out: the planner attends to all."""
    scores, labels = outputs.lines.class_logits[-1, 0].sigmoid().max(-1)
    classes = np.asarray(config.line_decoder.classes)[labels.cpu().numpy()]
    return MapLines(tuple(line_places(outputs.lines.points[-1, 0], config)), classes, as_array(scores))


def _nearest(objects: Boxes3D, place: tuple[float, float]) -> int:
    assert objects.scores is not None
    distances = np.linalg.norm(objects.centers[:, :2] - place, axis=-1)
    is_sure = objects.scores >= MIN_SCORE
    return int(np.where(is_sure | ~is_sure.any(), distances, np.inf).argmin())


def _paths(offsets: Tensor, start: Array) -> Array:
    """Movements (K, T, 2) -> places (K, T + 1, 2)."""
    moved = as_array(offsets).cumsum(1)
    return start + np.concatenate([np.zeros_like(moved[:, :1]), moved], axis=1)


@contextmanager
def attention_weights(*layers: AttentionLayer) -> Iterator[dict[AttentionLayer, Tensor]]:
    """A dict that is filled with the `AttentionLayer.weights` of each call inside the context; the last call stays."""
    found: dict[AttentionLayer, Tensor] = {}

    def keep(layer: AttentionLayer, arguments: tuple[Tensor, ...]) -> None:
        found[layer] = layer.weights(*arguments)

    with ExitStack() as hooks:
        for layer in layers:
            hooks.enter_context(layer.register_forward_pre_hook(keep))
        yield found
