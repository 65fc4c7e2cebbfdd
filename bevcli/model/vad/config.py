"""The configuration of a VAD."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

from bevcli.frame import FrameResult, MapLines, Plan
from bevcli.model.config import ModelConfig
from bevcli.model.vad.line_decoder import LineDecoderConfig
from bevcli.model.vad.loss_weights import LossWeights
from bevcli.model.vad.motion_head import MotionConfig


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
