"""The configuration of a VAD, with the weights of its losses."""

from collections.abc import Mapping
from dataclasses import astuple, dataclass, field
from typing import ClassVar

from bevcli.frame import FrameResult
from bevcli.model.config import ModelConfig
from bevcli.workshop.vad.line_decoder import LineDecoderConfig
from bevcli.workshop.vad.map_lines import MapLines
from bevcli.workshop.vad.motion_head import MotionConfig
from bevcli.workshop.vad.plan import Plan


@dataclass(frozen=True)
class LossWeights:
    """The [loss_weights] table: weights of the losses of lines, futures and paths. Defaults: as published (stage 2).

    Attributes:
        line_class: of the focal loss of the lines' classes; also of their cost in the matching.
        line_points: of the L1 loss of the lines' points, summed, as shares of the range; also of their cost.
        line_direction: of 1 minus the cosine between the segments of a line and the true ones.
        future: of the L1 loss of the movements in the best mode of an object.
        mode: of the focal loss of the modes.
        plan: of the L1 loss of the movements of the vehicle.
        boundary: of the shares of a metre by which planned places are nearer than that to a boundary.
        collision: of the metres by which planned places are too near to vehicles.
        direction: of the angle between the planned path and the nearest divider, radians.
    """

    line_class: float = 0.8
    line_points: float = 0.4
    line_direction: float = 0.005
    future: float = 0.2
    mode: float = 0.2
    plan: float = 1.0
    boundary: float = 1.0
    collision: float = 1.0
    direction: float = 0.5

    def __post_init__(self) -> None:
        if min(astuple(self)) < 0:
            raise ValueError("the weights must not be negative")


@dataclass(frozen=True, kw_only=True)
class VADConfig(ModelConfig):
    """A whole VAD.

    Attributes:
        commands: of the driver, in the order of the planned paths.
        line_decoder: the map decoder.
        motion: the motion head and the planner.
        loss_weights: of the losses of lines, futures and paths.
    """

    architecture: ClassVar[str] = "VAD"

    commands: tuple[str, ...] = ("right", "left", "straight")
    line_decoder: LineDecoderConfig = field(default_factory=LineDecoderConfig)
    motion: MotionConfig = field(default_factory=MotionConfig)
    loss_weights: LossWeights = field(default_factory=LossWeights)

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
