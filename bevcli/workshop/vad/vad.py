"""VAD (Jiang et al. 2023): BEVFormer's BEV map and objects, lines of the map, futures of objects, a planned path."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar, Self

import numpy as np
import torch
from torch import Tensor

from bevcli.errors import ConfigError
from bevcli.frame import BevMap, FrameResult
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array
from bevcli.model.bevformer.bevformer import BEVFormer
from bevcli.model.config import ModelConfig
from bevcli.model.decoder import ConstantSelfAttention, best_boxes, best_classes
from bevcli.model.network import STAGES
from bevcli.model.step import ModelOutputs
from bevcli.model.temporal_model import OfficialNames, Renames
from bevcli.model.upload import without_autocast
from bevcli.workshop.formats.map_lines import MapLines
from bevcli.workshop.vad import heads
from bevcli.workshop.vad.plan import Plan


@dataclass(frozen=True, kw_only=True)
class VADConfig(ModelConfig):
    """A whole VAD."""

    architecture: ClassVar[str] = "VAD"

    commands: tuple[str, ...] = ("right", "left", "straight")  # of the driver, in the order of the planned paths
    line_decoder: heads.LineDecoderConfig = field(default_factory=heads.LineDecoderConfig)  # the map decoder
    motion: heads.MotionConfig = field(default_factory=heads.MotionConfig)  # the motion head and the planner

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

    @property
    def future_times_s(self) -> tuple[float, ...]:
        return tuple(self.motion.step_s * step for step in range(1, self.motion.steps + 1))

    def check_training(self, clip_frames: int) -> None:
        raise ConfigError(f"{self.name}: a VAD cannot be trained; expected a BEVFormer, such as tiny, small or base")


_RENAMES: Renames = (
    (r"^pts_bbox_head\.map_instance_embedding\.weight$", "line_decoder.line_embedding"),
    (r"^pts_bbox_head\.map_pts_embedding\.weight$", "line_decoder.point_embedding"),
    (r"^pts_bbox_head\.transformer\.map_reference_points\.", "line_decoder.reference_points."),
    (r"^pts_bbox_head\.transformer\.map_decoder\.", "line_decoder."),
    (r"^pts_bbox_head\.map_cls_branches\.", "line_decoder.class_branches."),
    (r"^pts_bbox_head\.map_reg_branches\.", "line_decoder.point_branches."),
    (r"^pts_bbox_head\.lane_encoder\.layer_seq\.lmlp_(\d)\.mlp\.", r"line_encoder.layers.\1."),
    (r"^pts_bbox_head\.motion_mode_query\.weight$", "motion_head.mode_queries"),
    (r"^pts_bbox_head\.motion_decoder\.layers\.0\.", "motion_head.agent_attention."),
    (r"^pts_bbox_head\.pos_mlp_sa\.", "motion_head.agent_position."),
    (r"^pts_bbox_head\.motion_map_decoder\.layers\.0\.", "motion_head.line_attention."),
    (r"^pts_bbox_head\.pos_mlp\.", "motion_head.line_position."),
    (r"^pts_bbox_head\.traj_branches\.0\.", "motion_head.trajectory_branch."),
    (r"^pts_bbox_head\.traj_cls_branches\.0\.", "motion_head.mode_branch."),
    (r"^pts_bbox_head\.agent_fus_mlp\.", "motion_head.agent_fusion."),
    (r"^pts_bbox_head\.ego_query\.weight$", "planner.ego_query"),
    (r"^pts_bbox_head\.ego_agent_decoder\.layers\.0\.", "planner.agent_attention."),
    (r"^pts_bbox_head\.ego_agent_pos_mlp\.", "planner.agent_position."),
    (r"^pts_bbox_head\.ego_map_decoder\.layers\.0\.", "planner.line_attention."),
    (r"^pts_bbox_head\.ego_map_pos_mlp\.", "planner.line_position."),
    (r"^pts_bbox_head\.ego_fut_decoder\.", "planner.path_branch."),
    (r"^((motion_head|planner)\..*)\.attentions\.0\.attn\.", r"\1.attention."),
)

# The weights of the loss are used in training only.
OFFICIAL_NAMES = OfficialNames(
    r"^pts_bbox_head\.map_", _RENAMES, unused=r"^pts_bbox_head\.map_code_weights$", unused_text="{first}"
)

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


@dataclass(frozen=True, kw_only=True)
class VADOutputs(ModelOutputs):
    """The outputs of one step."""

    lines: heads.LineOutputs  # of the map
    motion: heads.MotionOutputs  # the futures of the object queries
    plan: Tensor  # (B, commands, T, 2) movement of the vehicle in each step along x and y of the bev frame, metres

    @property
    def by_name(self) -> dict[str, Tensor]:
        """See `ModelOutputs`."""
        return {
            **super().by_name,
            "line_class_logits": self.lines.class_logits[-1],
            "line_points": self.lines.points[-1],
            "future_offsets": self.motion.offsets,
            "mode_logits": self.motion.mode_logits,
            "plan_offsets": self.plan,
        }

    @classmethod
    def of_names(cls, tensors: Mapping[str, Tensor]) -> Self:
        """See `ModelOutputs`. Features between the heads are not in the file."""
        base, none = ModelOutputs.of_names(tensors), torch.zeros(0)
        return cls(
            base.bev,
            base.class_logits,
            base.box_codes,
            lines=heads.LineOutputs(tensors["line_class_logits"][None], tensors["line_points"][None], none),
            motion=heads.MotionOutputs(tensors["future_offsets"], tensors["mode_logits"], none),
            plan=tensors["plan_offsets"],
        )

    @classmethod
    def ports(cls, config: ModelConfig) -> Iterator[tuple[str, tuple[int, ...], str]]:
        """See `ModelOutputs`."""
        assert isinstance(config, VADConfig)
        yield from super().ports(config)
        lines, motion, queries = config.line_decoder, config.motion, config.decoder.queries
        commands = config.commands
        yield (
            "line_class_logits",
            (1, lines.lines, len(lines.classes)),
            f"(1, N, classes): of lines of the map: {', '.join(lines.classes)}.",
        )
        yield (
            "line_points",
            (1, lines.lines, lines.line_points, 2),
            "(1, N, P, 2): points of the lines, x and y, 0 to 1 over x_range_m and y_range_m.",
        )
        yield (
            "future_offsets",
            (1, queries, motion.modes, motion.steps, 2),
            f"(1, Q, M, T, 2): movement of each object in each step of {motion.step_s:g} s, x and y in metres, bev "
            "frame. Sums over the steps, added to the centre, are places.",
        )
        yield "mode_logits", (1, queries, motion.modes), "(1, Q, M): of the futures."
        yield (
            "plan_offsets",
            (1, len(commands), motion.steps, 2),
            f"(1, commands, T, 2): movement of the vehicle in each step, for the commands {', '.join(commands)}.",
        )

    def last_layers(self) -> Self:
        """See `ModelOutputs`. Features, which only the network uses, are left out."""
        lines, none = self.lines, self.plan[:0]
        last = heads.LineOutputs(lines.class_logits[-1:], lines.points[-1:], none)
        return replace(super().last_layers(), lines=last, motion=replace(self.motion, features=none))


class VAD(BEVFormer):
    """The whole model: a recurrence, in which the BEV map of a frame is the history of the next."""

    config: VADConfig
    config_class = VADConfig
    stages: Mapping[str, str] = STAGES | {"line_decoder": "map_decoder", "motion_head": "motion", "planner": "planner"}
    outputs_type = VADOutputs
    official_names = OFFICIAL_NAMES

    def __init__(self, config: VADConfig) -> None:
        super().__init__(config)
        self.line_decoder = heads.LineDecoder(config.line_decoder, config.channels, config.bev_grid)
        self.line_encoder = heads.LineEncoder(config.channels)
        self.motion_head = heads.MotionHead(config.motion, config.channels)
        self.planner = heads.Planner(config.motion, len(config.commands), config.channels)

    def fix_constant_parts(self) -> None:
        """The queries of objects and of lines attend to each other before they see the frame: computed once."""
        super().fix_constant_parts()
        first = self.line_decoder.layers[0]
        first.self_attention = ConstantSelfAttention(first, self.line_decoder.queries(batch=1))

    def part_names(self) -> Iterator[tuple[str, ...]]:
        """See `TemporalModel`."""
        yield from super().part_names()
        yield from PART_NAMES

    def detect(self, bev: Tensor) -> VADOutputs:
        """The outputs for a BEV map (B, Y·X, C)."""
        with without_autocast(bev.device):
            class_logits, box_codes, features = self.decoder(bev.float(), self.detection_head)
            lines, motion, plan = self.further(bev.float(), box_codes[-1], features)
        return VADOutputs(bev, class_logits, box_codes, lines=lines, motion=motion, plan=plan)

    def further(
        self, bev: Tensor, box_codes: Tensor, features: Tensor
    ) -> tuple[heads.LineOutputs, heads.MotionOutputs, Tensor]:
        """Lines, futures and plan for a BEV map, and box codes (B, Q, 10) and features (B, Q, C) of objects."""
        lines = self.line_decoder(bev)
        tokens, positions = self.map_tokens(lines), self.positions(box_codes)
        motion = self.motion_head(features, positions, tokens)
        return lines, motion, self.planner(motion.features, positions, tokens)

    def map_tokens(self, lines: heads.LineOutputs) -> heads.MapTokens:
        scores = lines.class_logits[-1].sigmoid().amax(-1)
        return heads.MapTokens(self.line_encoder(lines.features), heads.line_positions(lines.points[-1]), scores)

    def positions(self, box_codes: Tensor) -> Tensor:
        """x and y (B, Q, 2), 0 to 1 over the range, of box codes (B, Q, 10)."""
        head = self.detection_head
        return (box_codes[..., :2] - head.range_start[:2]) / head.range_extent[:2]

    def decode(self, outputs: ModelOutputs) -> Iterator[Boxes3D | BevMap | FrameResult]:
        assert isinstance(outputs, VADOutputs)
        yield decode_futures(outputs, self.config)
        yield decode_lines(outputs, self.config)
        yield decode_plan(outputs, self.config)


def decode_futures(outputs: VADOutputs, config: VADConfig) -> Boxes3D:
    """The boxes of `ModelOutputs.boxes`, with futures: the places of each object's centre in each mode."""
    best = best_boxes(outputs.class_logits[-1], outputs.box_codes[-1], config.decoder)
    boxes, queries = best.decoded(config.classes), best.query[0]
    offsets = _array(outputs.motion.offsets[0, queries])  # (K, M, T, 2)
    places = boxes.centers[:, None, None, :2] + offsets.cumsum(2)
    seconds = np.broadcast_to(np.array(config.future_times_s)[:, None], (*places.shape[:3], 1))
    scores = _array(outputs.motion.mode_logits[0, queries].sigmoid())
    return replace(boxes, futures=np.concatenate([seconds, places], axis=-1), future_scores=scores)


def decode_lines(outputs: VADOutputs, config: VADConfig) -> MapLines:
    """The line_decoder.max_lines lines with the best scores, by falling score, bev frame; see `best_classes`."""
    decoder = config.line_decoder
    scores, queries, labels = (column[0] for column in best_classes(outputs.lines.class_logits[-1], decoder.max_lines))
    (x0, x1), (y0, y1) = config.bev_grid.x_range_m, config.bev_grid.y_range_m
    points = _array(outputs.lines.points[-1, 0, queries]) * (x1 - x0, y1 - y0) + (x0, y0)  # (K, P, 2)
    return MapLines(tuple(points), np.asarray(decoder.classes)[labels.cpu().numpy()], _array(scores))


def decode_plan(outputs: VADOutputs, config: VADConfig) -> Plan:
    """The planned paths, bev frame."""
    return Plan(config.commands, _array(outputs.plan[0]).cumsum(1), np.array(config.future_times_s))


def _array(values: Tensor) -> Array:
    array: Array = values.double().cpu().numpy()
    return array
