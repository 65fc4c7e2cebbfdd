"""The exported form of a VAD."""

from collections.abc import Iterator, Mapping

import torch
from torch import Tensor

from bevcli.model.step import ModelOutputs
from bevcli.workshop.engines.export_form import Port, RecurrentForm
from bevcli.workshop.vad.config import VADConfig
from bevcli.workshop.vad.line_decoder import LineOutputs
from bevcli.workshop.vad.motion_head import MotionOutputs
from bevcli.workshop.vad.vad import VADOutputs


class VADForm(RecurrentForm):
    """The exported form: BEVFormer's, with lines, futures and planned paths as further outputs."""

    config: VADConfig

    def further_outputs(self) -> Iterator[Port]:
        lines, motion, queries = self.config.line_decoder, self.config.motion, self.config.decoder.queries
        commands = self.config.commands
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
            f"(1, Q, M, T, 2): movement of each object in each step of {motion.step_s:g} s, x and y in metres, bev "
            "frame. Sums over the steps, added to the centre, are places.",
        )
        yield Port("mode_logits", (1, queries, motion.modes), "(1, Q, M): of the futures.")
        yield Port(
            "plan_offsets",
            (1, len(commands), motion.steps, 2),
            f"(1, commands, T, 2): movement of the vehicle in each step, for the commands {', '.join(commands)}.",
        )

    def model_outputs(self, outputs: ModelOutputs, by_name: Mapping[str, Tensor]) -> VADOutputs:
        none = torch.zeros(0)  # features between the heads are not in the file
        lines = LineOutputs(by_name["line_class_logits"][None], by_name["line_points"][None], none)
        motion = MotionOutputs(by_name["future_offsets"], by_name["mode_logits"], none)
        parts = outputs.bev, outputs.class_logits, outputs.box_codes
        return VADOutputs(*parts, lines=lines, motion=motion, plan=by_name["plan_offsets"])
