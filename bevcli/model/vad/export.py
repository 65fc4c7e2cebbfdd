"""The exported form of a VAD: BEVFormer's, with lines, futures and planned paths as further outputs."""

from collections.abc import Iterator, Mapping

import torch
from torch import Tensor

from bevcli.model.bevformer.bevformer import RecurrentForm, RecurrentStep
from bevcli.model.export_form import Port, box_ports
from bevcli.model.export_step import decode_boxes
from bevcli.model.step import ModelOutputs
from bevcli.model.vad.config import VADConfig
from bevcli.model.vad.decoding import VADOutputs
from bevcli.model.vad.line_decoder import LineOutputs
from bevcli.model.vad.motion_head import MotionOutputs


class VADStep(RecurrentStep):
    """`VAD.forward` as a graph."""

    def outputs(self, bev: Tensor, most_cameras: Tensor) -> tuple[Tensor, ...]:
        """The outputs in the order of `VADForm.outputs`."""
        found = self.network.detect(bev)
        logits, codes, of_heads = found.class_logits[-1], found.box_codes[-1], _of_heads(found).values()
        boxes = decode_boxes(logits, codes, self.config) if self.decode else ()
        return (bev, logits, codes, most_cameras, *of_heads, *boxes)


class VADForm(RecurrentForm):
    """As BEVFormer's, with further outputs."""

    step = VADStep
    config: VADConfig

    def outputs(self, *, decode: bool) -> tuple[Port, ...]:
        boxes = box_ports(self.config) if decode else ()
        return (*super().outputs(decode=False), *_ports(self.config), *boxes)

    def model_outputs(self, outputs: ModelOutputs, found: Mapping[str, Tensor]) -> VADOutputs:
        none = torch.zeros(0)  # features between the heads are not in the file
        lines = LineOutputs(found["line_class_logits"][None], found["line_points"][None], none)
        motion = MotionOutputs(found["future_offsets"], found["mode_logits"], none)
        parts = outputs.bev, outputs.class_logits, outputs.box_codes
        return VADOutputs(*parts, lines=lines, motion=motion, plan=found["plan_offsets"])

    def further_outputs(self, outputs: ModelOutputs) -> dict[str, Tensor]:
        assert isinstance(outputs, VADOutputs)
        return _of_heads(outputs)


def _of_heads(outputs: VADOutputs) -> dict[str, Tensor]:
    """The outputs of `_ports`."""
    lines, motion = outputs.lines, outputs.motion
    return {
        "line_class_logits": lines.class_logits[-1],
        "line_points": lines.points[-1],
        "future_offsets": motion.offsets,
        "mode_logits": motion.mode_logits,
        "plan_offsets": outputs.plan,
    }


def _ports(config: VADConfig) -> Iterator[Port]:
    lines, motion, queries = config.line_decoder, config.motion, config.decoder.queries
    yield Port(
        "line_class_logits",
        (1, lines.lines, len(lines.classes)),
        f"(1, N, classes): of lines of the map: {', '.join(lines.classes)}.",
    )
    yield Port(
        "line_points",
        (1, lines.lines, lines.line_points, 2),
        "(1, N, P, 2): points of the lines, x and y, 0 to 1 over x_range_m and y_range_m.",
    )
    yield Port(
        "future_offsets",
        (1, queries, motion.modes, motion.steps, 2),
        f"(1, Q, M, T, 2): movement of each object in each step of {motion.step_s:g} s, x and y in metres, bev frame. "
        "Sums over the steps, added to the centre, are places.",
    )
    yield Port("mode_logits", (1, queries, motion.modes), "(1, Q, M): of the futures.")
    yield Port(
        "plan_offsets",
        (1, len(config.commands), motion.steps, 2),
        f"(1, commands, T, 2): movement of the vehicle in each step, for the commands {', '.join(config.commands)}.",
    )
