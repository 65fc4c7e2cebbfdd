"""VAD (Jiang et al. 2023): BEVFormer's BEV map and objects, lines of the map, futures of objects, a planned path.

Then its exported form.
"""

from collections.abc import Iterator, Mapping

import torch
from torch import Tensor

from bevcli.frame import FrameResult
from bevcli.geometry.boxes import Boxes3D
from bevcli.model.bevformer.bevformer import BEVFormer, RecurrentForm
from bevcli.model.config import ModelConfig
from bevcli.model.network import STAGES, ConstantSelfAttention
from bevcli.model.pillar_projection import PillarHits
from bevcli.model.step import ModelOutputs, SceneAttention
from bevcli.workshop.engines.export_form import Port
from bevcli.workshop.vad.config import VADConfig
from bevcli.workshop.vad.decoding import VADOutputs, decode_futures, decode_lines, decode_plan, scene_attentions
from bevcli.workshop.vad.line_decoder import LineDecoder, LineEncoder, LineOutputs
from bevcli.workshop.vad.motion_head import MapTokens, MotionHead, MotionOutputs, attention_weights, line_positions
from bevcli.workshop.vad.official_keys import NAMES, UNUSED
from bevcli.workshop.vad.planner import Planner


class VAD(BEVFormer):
    """The whole model: a recurrence, in which the BEV map of a frame is the history of the next."""

    config: VADConfig
    config_class = VADConfig
    stages: Mapping[str, str] = STAGES | {"line_decoder": "map_decoder", "motion_head": "motion", "planner": "planner"}
    official_names = NAMES
    figures = (*BEVFormer.figures, "bevcli.workshop.explain.attention_figures:FIGURES")

    def __init__(self, config: VADConfig) -> None:
        super().__init__(config)
        self.line_decoder = LineDecoder(config.line_decoder, config.channels, config.bev_grid)
        self.line_encoder = LineEncoder(config.channels)
        self.motion_head = MotionHead(config.motion, config.channels)
        self.planner = Planner(config.motion, len(config.commands), config.channels)

    def detect(self, bev: Tensor) -> VADOutputs:
        """The outputs for a BEV map (B, Y·X, C)."""
        with torch.autocast(bev.device.type, enabled=False):
            class_logits, box_codes, features = self.decoder(bev.float(), self.detection_head)
            lines, motion, plan = self.further(bev.float(), box_codes[-1], features)
        return VADOutputs(bev, class_logits, box_codes, lines=lines, motion=motion, plan=plan)

    def further(self, bev: Tensor, box_codes: Tensor, features: Tensor) -> tuple[LineOutputs, MotionOutputs, Tensor]:
        """Lines, futures and plan for a BEV map, and box codes (B, Q, 10) and features (B, Q, C) of objects."""
        lines = self.line_decoder(bev)
        tokens, positions = self.map_tokens(lines), self.positions(box_codes)
        motion = self.motion_head(features, positions, tokens)
        return lines, motion, self.planner(motion.features, positions, tokens)

    def map_tokens(self, lines: LineOutputs) -> MapTokens:
        scores = lines.class_logits[-1].sigmoid().amax(-1)
        return MapTokens(self.line_encoder(lines.features), line_positions(lines.points[-1]), scores)

    def positions(self, box_codes: Tensor) -> Tensor:
        """x and y (B, Q, 2), 0 to 1 over the range, of box codes (B, Q, 10)."""
        head = self.detection_head
        return (box_codes[..., :2] - head.range_start[:2]) / head.range_extent[:2]

    def decode_boxes(self, outputs: ModelOutputs) -> Boxes3D:
        assert isinstance(outputs, VADOutputs)
        return decode_futures(outputs, self.config)

    def decode_results(self, outputs: ModelOutputs) -> tuple[FrameResult, ...]:
        assert isinstance(outputs, VADOutputs)
        return decode_lines(outputs, self.config), decode_plan(outputs, self.config)

    def scene_attentions(self, outputs: ModelOutputs, place: tuple[float, float]) -> dict[str, SceneAttention]:
        """See `TemporalModel`. The heads run again: outputs have no attention weights."""
        assert isinstance(outputs, VADOutputs)
        planner, motion = self.planner, self.motion_head
        layers = (planner.agent_attention, planner.line_attention, motion.agent_attention, motion.line_attention)
        with attention_weights(*layers) as found:
            self.detect(outputs.bev)
        return scene_attentions(outputs, [found[layer] for layer in layers], self.config, place)

    def exchange_parts(self) -> None:
        """See `TemporalModel`: the queries of objects and of lines attend to each other before they see the frame."""
        super().exchange_parts()
        first = self.line_decoder.layers[0]
        first.self_attention = ConstantSelfAttention(first, self.line_decoder.queries(batch=1))

    def run_on_shapes(self, images: Tensor, camera_index: Tensor, hits: PillarHits) -> Tensor:
        bev, queries = super().run_on_shapes(images, camera_index, hits), self.config.decoder.queries
        self.further(bev, torch.empty(1, queries, 10), torch.empty(1, queries, self.config.channels))
        return bev

    @classmethod
    def export_form(cls, config: ModelConfig, cameras: int) -> "VADForm":
        return VADForm(config, cameras)

    @classmethod
    def without_training_parts(cls, state: Mapping[str, Tensor]) -> tuple[dict[str, Tensor], str]:
        return {key: tensor for key, tensor in state.items() if key != UNUSED}, UNUSED if UNUSED in state else ""

    @classmethod
    def part_names(cls, config: ModelConfig) -> Iterator[tuple[str, ...]]:
        yield from super().part_names(config)
        yield "map decoder", "line_decoder"
        yield "line encoder", "line_encoder"
        yield "motion head: objects to objects", "motion_head.agent_attention", "motion_head.agent_position"
        yield "motion head: objects to lines", "motion_head.line_attention", "motion_head.line_position"
        yield "motion head: futures", "motion_head"
        yield "planner: vehicle to objects", "planner.agent_attention", "planner.agent_position"
        yield "planner: vehicle to lines", "planner.line_attention", "planner.line_position"
        yield "planner: paths", "planner"


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

    def model_outputs(self, outputs: ModelOutputs, found: Mapping[str, Tensor]) -> VADOutputs:
        none = torch.zeros(0)  # features between the heads are not in the file
        lines = LineOutputs(found["line_class_logits"][None], found["line_points"][None], none)
        motion = MotionOutputs(found["future_offsets"], found["mode_logits"], none)
        parts = outputs.bev, outputs.class_logits, outputs.box_codes
        return VADOutputs(*parts, lines=lines, motion=motion, plan=found["plan_offsets"])
