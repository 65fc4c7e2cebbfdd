"""VAD (Jiang et al. 2023): BEVFormer's BEV map and objects, lines of the map, futures of objects, a planned path."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar, NoReturn

import numpy as np
import torch
from torch import Tensor

from bevcli.errors import BevcliError, ConfigError
from bevcli.frame import FrameResult, MapLines, Plan
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array
from bevcli.model.bevformer.bevformer import BEVFormer
from bevcli.model.box_coding import best_queries, decode
from bevcli.model.config import ModelConfig
from bevcli.model.network import STAGES, ConstantSelfAttention
from bevcli.model.pillar_projection import PillarHits
from bevcli.model.step import ModelOutputs
from bevcli.model.vad.line_decoder import LineDecoder, LineDecoderConfig, LineEncoder, LineOutputs
from bevcli.model.vad.motion_head import MapTokens, MotionConfig, MotionHead, MotionOutputs, line_positions
from bevcli.model.vad.official_keys import NAMES, UNUSED
from bevcli.model.vad.planner import Planner


@dataclass(frozen=True, kw_only=True)
class VADConfig(ModelConfig):
    """A whole VAD.

    Attributes:
        commands: of the driver, in the order of the planned paths.
        line_decoder: the map decoder.
        motion: the motion head and the planner.
    """

    architecture: ClassVar[str] = "VAD"

    commands: tuple[str, ...] = ("right", "left", "straight")
    line_decoder: LineDecoderConfig = field(default_factory=LineDecoderConfig)
    motion: MotionConfig = field(default_factory=MotionConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.heads != ("detection",) or self.decoder.training_groups != 1:
            raise ValueError('heads must be ["detection"] and decoder.training_groups 1: VAD has heads of its own')
        if self.channels % self.line_decoder.attention_heads or self.channels % self.motion.attention_heads:
            raise ValueError(f"channels is {self.channels}; it must be a multiple of the attention_heads")
        if not self.commands or len(set(self.commands)) < len(self.commands):
            raise ValueError("commands must name at least one command, and none twice")

    @property
    def results(self) -> Mapping[type[FrameResult], tuple[str, ...]]:
        return {MapLines: self.line_decoder.classes, Plan: self.commands}

    def check_training(self, clip_frames: int) -> None:
        raise ConfigError(f"{self.name}: a VAD cannot be trained; expected a BEVFormer, such as tiny, small or base")


@dataclass(frozen=True, kw_only=True)
class VADOutputs(ModelOutputs):
    """The outputs of one step.

    Attributes:
        lines: of the map.
        motion: the futures of the object queries.
        plan: (B, commands, T, 2) movement of the vehicle in each step along x and y of the bev frame, metres.
    """

    stays_on_device: ClassVar[bool] = True

    lines: LineOutputs
    motion: MotionOutputs
    plan: Tensor


class VAD(BEVFormer):
    """The whole model: a recurrence, in which the BEV map of a frame is the history of the next."""

    config: VADConfig
    config_class = VADConfig
    stages: Mapping[str, str] = STAGES | {"line_decoder": "map_decoder", "motion_head": "motion", "planner": "planner"}
    official_names = NAMES
    is_explained = False

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
            lines = self.line_decoder(bev.float())
            tokens = self.map_tokens(lines)
            positions = self.positions(box_codes[-1])
            motion = self.motion_head(features, positions, tokens)
            plan = self.planner(motion.features, positions, tokens)
        return VADOutputs(bev, class_logits, box_codes, lines=lines, motion=motion, plan=plan)

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

    def exchange_parts(self) -> None:
        """See `TemporalModel`: the queries of objects and of lines attend to each other before they see the frame."""
        super().exchange_parts()
        first = self.line_decoder.layers[0]
        first.self_attention = ConstantSelfAttention(first, self.line_decoder.queries(batch=1))

    def run_on_shapes(self, images: Tensor, camera_index: Tensor, hits: PillarHits) -> Tensor:
        bev = super().run_on_shapes(images, camera_index, hits)
        self.detect(bev)
        return bev

    @classmethod
    def export_form(cls, config: ModelConfig, cameras: int) -> NoReturn:
        raise BevcliError(
            f"{config.name}: a VAD cannot be exported (expected a BEVFormer or a BEVFormerV2, such as tiny)"
        )

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


def decode_futures(outputs: VADOutputs, config: VADConfig) -> Boxes3D:
    """The boxes of `bevcli.model.box_coding.decode`, with futures: the places of each object's centre in each mode."""
    boxes, queries = decode(outputs, config)[0], best_queries(outputs, config)[0][0]
    offsets = outputs.motion.offsets[0, queries].double().cpu().numpy()  # (K, M, T, 2)
    places = boxes.centers[:, None, None, :2] + offsets.cumsum(2)
    seconds = np.broadcast_to(step_times(config)[:, None], (*places.shape[:3], 1))
    scores = outputs.motion.mode_logits[0, queries].sigmoid().double().cpu().numpy()
    return replace(boxes, futures=np.concatenate([seconds, places], axis=-1), future_scores=scores)


def decode_lines(outputs: VADOutputs, config: VADConfig) -> MapLines:
    """The line_decoder.max_lines lines with the best scores, by falling score, bev frame.

    A query gives one line for each of its classes that is among the best scores.
    """
    decoder, grid = config.line_decoder, config.bev_grid
    scores = outputs.lines.class_logits[-1, 0].sigmoid().flatten()  # (N · classes,)
    best, index = scores.topk(min(decoder.max_lines, len(scores)))
    points = outputs.lines.points[-1, 0, index // len(decoder.classes)].double().cpu().numpy()  # (K, P, 2)
    (x0, x1), (y0, y1) = grid.x_range_m, grid.y_range_m
    classes = np.asarray(decoder.classes)[(index % len(decoder.classes)).cpu().numpy()]
    return MapLines(tuple(points * (x1 - x0, y1 - y0) + (x0, y0)), classes, best.double().cpu().numpy())


def decode_plan(outputs: VADOutputs, config: VADConfig) -> Plan:
    """The planned paths, bev frame."""
    return Plan(config.commands, outputs.plan[0].double().cpu().numpy().cumsum(1), step_times(config))


def step_times(config: VADConfig) -> Array:
    """(T,) seconds from the frame's time to the end of each step."""
    return config.motion.step_s * np.arange(1.0, config.motion.steps + 1)
