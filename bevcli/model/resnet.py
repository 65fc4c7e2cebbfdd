"""ResNet (He et al. 2016) with bottlenecks: the image backbone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class ResNetConfig:
    """blocks: bottlenecks of the four stages; (3, 4, 6, 3) is ResNet-50, (3, 4, 23, 3) ResNet-101.

    style: where a stage's stride sits: "pytorch" in the 3x3, "caffe" in the first 1x1.
    output_stages: the stages (1 to 4) whose maps go on to the neck.
    deformable_stages: the stages whose 3x3 are modulated deformable convolutions (DCNv2).
    width: channels of the stem; stage s puts out 4 · width · 2^(s - 1).
    """

    blocks: tuple[int, int, int, int] = (3, 4, 6, 3)
    style: Literal["pytorch", "caffe"] = "pytorch"
    output_stages: tuple[int, ...] = (4,)
    deformable_stages: tuple[int, ...] = ()
    width: int = 64

    def __post_init__(self) -> None:
        stages = self.output_stages + self.deformable_stages
        if not self.output_stages or not set(stages) <= {1, 2, 3, 4}:
            raise ValueError("output_stages and deformable_stages name stages 1 to 4")

    def output_channels(self) -> tuple[int, ...]:
        """Channels of the map of each output stage."""
        return tuple(4 * self.width * 2 ** (stage - 1) for stage in self.output_stages)
