"""EfficientNet-lite: an image backbone of inverted residual blocks with depthwise convolutions.

EfficientNet (Tan and Le 2019) without squeeze-and-excitation, with ReLU6, and with a stem of fixed width.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch.nn.functional as F
from torch import Tensor, nn

from bevcli.model.backbone import Backbone, Stage

VARIANTS = ((1.0, 1.0), (1.0, 1.1), (1.1, 1.2), (1.2, 1.4), (1.4, 1.8))  # factors of width and depth of lite0 to lite4
STEM_CHANNELS = 32  # of all variants
# Of each stage of lite0: blocks, kernel size, stride, expansion of the channels, output channels.
STAGES = (
    (1, 3, 1, 1, 16),
    (2, 3, 2, 6, 24),
    (2, 5, 2, 6, 40),
    (3, 3, 2, 6, 80),
    (3, 5, 1, 6, 112),
    (4, 5, 2, 6, 192),
    (1, 3, 1, 6, 320),
)
STRIDES = (2, 4, 8, 16, 16, 32, 32)  # pixels of the image per cell after each stage


@dataclass(frozen=True)
class EfficientNetLiteConfig:
    """The backbone."""

    title: ClassVar[str] = "EfficientNet-lite"

    kind: Literal["efficientnet-lite"] = "efficientnet-lite"  # chooses this backbone
    variant: int = 0  # 0 to 4, from EfficientNet-lite0, the smallest, to EfficientNet-lite4
    # the stages (1 to 7, with strides 2, 4, 8, 16, 16, 32 and 32) whose maps go to the neck. The model has no stages
    # after the last of them
    output_stages: tuple[int, ...] = (3, 5)

    def __post_init__(self) -> None:
        if not 0 <= self.variant < len(VARIANTS):
            raise ValueError(f"variant must be from 0 to {len(VARIANTS) - 1}")
        if not self.output_stages or not set(self.output_stages) <= set(range(1, len(STAGES) + 1)):
            raise ValueError("output_stages must hold stages 1 to 7, at least one")

    def output_channels(self) -> tuple[int, ...]:
        """Channels of the map of each output stage."""
        return tuple(self.channels(stage) for stage in self.output_stages)

    def output_strides(self) -> tuple[int, ...]:
        """Pixels of the image per cell of the map of each output stage."""
        return tuple(STRIDES[stage - 1] for stage in self.output_stages)

    def stage_names(self) -> Iterator[str]:
        """Each stage that the model has, in words."""
        for number in range(1, max(self.output_stages) + 1):
            blocks = self.blocks(number)
            yield f"{blocks} inverted residual block{'s' * (blocks > 1)}"

    def build(self) -> "EfficientNetLite":
        """The backbone, with random weights."""
        return EfficientNetLite(self)

    def channels(self, stage: int) -> int:
        """Output channels of a stage (1 to 7): scaled, then rounded to a multiple of 8, at most a tenth lower."""
        scaled = STAGES[stage - 1][4] * VARIANTS[self.variant][0]
        rounded = max(8, int(scaled + 4) // 8 * 8)
        return rounded if rounded >= 0.9 * scaled else rounded + 8

    def blocks(self, stage: int) -> int:
        """Number of blocks of a stage (1 to 7). The first and the last stage have one in all variants."""
        blocks = STAGES[stage - 1][0]
        return blocks if stage in (1, len(STAGES)) else math.ceil(blocks * VARIANTS[self.variant][1])


class EfficientNetLite(Backbone):
    """See `EfficientNetLiteConfig`. Images are RGB, with mean 127 and standard deviation 128 where it is pretrained."""

    stem_parts = ("conv1", "bn1")
    batch_norms: ClassVar[Mapping[str, str]] = {"conv1": "bn1"}

    def __init__(self, config: EfficientNetLiteConfig) -> None:
        super().__init__()
        self.output_stages = config.output_stages
        self.conv1 = SameConvolution(3, STEM_CHANNELS, 3)
        self.bn1 = _norm(STEM_CHANNELS)
        self.stages = nn.ModuleList(_stage(number, config) for number in range(1, max(config.output_stages) + 1))
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                fan_out = module.out_channels // module.groups * math.prod(module.kernel_size)
                nn.init.normal_(module.weight, std=math.sqrt(2 / fan_out))

    def stem(self, images: Tensor) -> Tensor:
        """images: (B, 3, H, W) -> (B, 32, H / 2, W / 2)."""
        return F.relu6(self.bn1(self.conv1(images)))


class SameConvolution(nn.Conv2d):
    """A convolution of stride 2, padded as TensorFlow's "SAME": an even size has one row less before it than after it.

    An even size gets one row and column more on each side than the kernel needs, and the first result is left out: this
    costs less than a copy of the input with padding on two sides.
    """

    folds_batch_norm: ClassVar[bool] = True

    def __init__(self, in_channels: int, out_channels: int, kernel_size: int, groups: int = 1) -> None:
        super().__init__(in_channels, out_channels, kernel_size, stride=2, groups=groups, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """x: (B, in_channels, H, W) -> (B, out_channels, H / 2, W / 2), rounded up."""
        padding, rows, columns = self.padding_for(x)
        y = F.conv2d(x, self.weight, self.bias, self.stride, padding, groups=self.groups)
        return y[..., rows:, columns:]

    def padding_for(self, x: Tensor) -> tuple[list[int], int, int]:
        """Padding of rows and columns, and the number of first rows and columns to leave out of the result."""
        rows, columns = (1 - size % 2 for size in x.shape[-2:])
        half = self.kernel_size[0] // 2
        return [half + rows, half + columns], rows, columns


class InvertedResidual(nn.Module):
    """1x1 convolution to more channels, depthwise and 1x1 convolution, each with batch norm, and a shortcut."""

    batch_norms: ClassVar[Mapping[str, str]] = {
        "expand": "expand_norm", "depthwise": "depthwise_norm", "project": "project_norm"
    }  # fmt: skip

    def __init__(self, in_channels: int, channels: int, kernel_size: int, stride: int, expansion: int) -> None:
        super().__init__()
        self.adds = stride == 1 and in_channels == channels
        wide = expansion * in_channels
        self.expand: nn.Conv2d | None = None
        if expansion > 1:
            self.expand = nn.Conv2d(in_channels, wide, 1, bias=False)
            self.expand_norm = _norm(wide)
        self.depthwise: nn.Conv2d
        if stride == 1:
            self.depthwise = nn.Conv2d(wide, wide, kernel_size, padding=kernel_size // 2, groups=wide, bias=False)
        else:
            self.depthwise = SameConvolution(wide, wide, kernel_size, groups=wide)
        self.depthwise_norm = _norm(wide)
        self.project = nn.Conv2d(wide, channels, 1, bias=False)
        self.project_norm = _norm(channels)

    def forward(self, x: Tensor) -> Tensor:
        """x: (B, in_channels, H, W) -> (B, channels, H / stride, W / stride)."""
        y = x if self.expand is None else F.relu6(self.expand_norm(self.expand(x)))
        y = F.relu6(self.depthwise_norm(self.depthwise(y)))
        y = self.project_norm(self.project(y))
        return y + x if self.adds else y


def _norm(channels: int) -> nn.BatchNorm2d:
    return nn.BatchNorm2d(channels, eps=1e-3, momentum=0.01)


def _stage(number: int, config: EfficientNetLiteConfig) -> Stage:
    """The blocks of a stage (1 to 7); the first of them has the stride."""
    _, kernel_size, stride, expansion, _ = STAGES[number - 1]
    channels = config.channels(number)
    before = STEM_CHANNELS if number == 1 else config.channels(number - 1)
    inputs = [(before, stride)] + (config.blocks(number) - 1) * [(channels, 1)]
    return Stage(*(InvertedResidual(size, channels, kernel_size, stride, expansion) for size, stride in inputs))
