"""VAD (Jiang et al. 2023): BEVFormer's BEV map and objects, lines of the map, futures of objects, a planned path."""

from collections.abc import Iterator, Mapping

from torch import Tensor

from bevcli.frame import BevMap, FrameResult
from bevcli.geometry.boxes import Boxes3D
from bevcli.model.bevformer.bevformer import BEVFormer
from bevcli.model.network import STAGES
from bevcli.model.prepare import ConstantSelfAttention, fix_first_attention
from bevcli.model.step import ModelOutputs
from bevcli.model.tensors import without_autocast
from bevcli.workshop.vad.config import VADConfig
from bevcli.workshop.vad.decoding import VADOutputs, decode_futures, decode_lines, decode_plan
from bevcli.workshop.vad.line_decoder import LineDecoder, LineEncoder, LineOutputs
from bevcli.workshop.vad.motion_head import MapTokens, MotionHead, MotionOutputs, line_positions
from bevcli.workshop.vad.official_keys import OFFICIAL_NAMES
from bevcli.workshop.vad.planner import Planner

PART_NAMES = (
    ("map decoder", "line_decoder"),
    ("line encoder", "line_encoder"),
    ("motion head: objects to objects", "motion_head.agent_attention", "motion_head.agent_position"),
    ("motion head: objects to lines", "motion_head.line_attention", "motion_head.line_position"),
    ("motion head: futures", "motion_head"),
    ("planner: vehicle to objects", "planner.agent_attention", "planner.agent_position"),
    ("planner: vehicle to lines", "planner.line_attention", "planner.line_position"),
    ("planner: paths", "planner"),
)


class VAD(BEVFormer):
    """The whole model: a recurrence, in which the BEV map of a frame is the history of the next."""

    config: VADConfig
    config_class = VADConfig
    stages: Mapping[str, str] = STAGES | {"line_decoder": "map_decoder", "motion_head": "motion", "planner": "planner"}
    official_names = OFFICIAL_NAMES

    def __init__(self, config: VADConfig) -> None:
        super().__init__(config)
        self.line_decoder = LineDecoder(config.line_decoder, config.channels, config.bev_grid)
        self.line_encoder = LineEncoder(config.channels)
        self.motion_head = MotionHead(config.motion, config.channels)
        self.planner = Planner(config.motion, len(config.commands), config.channels)

    def detect(self, bev: Tensor) -> VADOutputs:
        """The outputs for a BEV map (B, Y·X, C)."""
        with without_autocast(bev.device):
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

    def decode(self, outputs: ModelOutputs) -> Iterator[Boxes3D | BevMap | FrameResult]:
        assert isinstance(outputs, VADOutputs)
        yield decode_futures(outputs, self.config)
        yield decode_lines(outputs, self.config)
        yield decode_plan(outputs, self.config)


def fix_first_attentions(model: VAD) -> None:
    """The queries of objects and of lines attend to each other before they see the frame: computed once."""
    fix_first_attention(model)
    first = model.line_decoder.layers[0]
    first.self_attention = ConstantSelfAttention(first, model.line_decoder.queries(batch=1))
