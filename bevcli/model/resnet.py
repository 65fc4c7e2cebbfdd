"""ResNet (He et al. 2016) with bottlenecks: the image backbone."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch.nn.functional as F
from torch import Tensor, nn

from bevcli.model.backbone import Backbone, Stage
from bevcli.model.deformable_convolution import ModulatedDeformableConvolution
from bevcli.parsing.documents import Count


@dataclass(frozen=True)
class ResNetConfig:
    """The backbone."""

    title: ClassVar[str] = "ResNet"

    # number of bottlenecks in each of the four stages; (3, 4, 6, 3) is ResNet-50, (3, 4, 23, 3) ResNet-101
    blocks: tuple[Count, Count, Count, Count] = (3, 4, 6, 3)
    # which convolution of a stage's first bottleneck has the stride: "pytorch" the 3x3, "caffe" the first 1x1
    style: Literal["pytorch", "caffe"] = "pytorch"
    output_stages: tuple[int, ...] = (4,)  # the stages (1 to 4) whose maps go to the neck
    # the stages whose 3x3 convolutions are modulated deformable convolutions (DCNv2)
    deformable_stages: tuple[int, ...] = ()
    width: Count = 64  # channels of the stem; stage s has 4 · width · 2^(s - 1) output channels
    kind: Literal["resnet"] = "resnet"  # chooses this backbone

    def __post_init__(self) -> None:
        stages = self.output_stages + self.deformable_stages
        if not self.output_stages or not set(stages) <= {1, 2, 3, 4}:
            raise ValueError("output_stages and deformable_stages must hold stages 1 to 4, output_stages at least one")

    def output_channels(self) -> tuple[int, ...]:
        """Channels of the map of each output stage."""
        return tuple(4 * self.width * 2 ** (stage - 1) for stage in self.output_stages)

    def output_strides(self) -> tuple[int, ...]:
        """Pixels of the image per cell of the map of each output stage."""
        return tuple(2 ** (stage + 1) for stage in self.output_stages)

    def stage_names(self) -> Iterator[str]:
        """Each stage in words."""
        for number, blocks in enumerate(self.blocks, 1):
            kind = "deformable bottleneck" if number in self.deformable_stages else "bottleneck"
            yield f"{blocks} {kind}{'s' * (blocks > 1)}"

    def build(self) -> "ResNet":
        """The backbone, with random weights."""
        return ResNet(self)


class ResNet(Backbone):
    """Images to feature maps of the configured output stages; the four stages have the strides 4, 8, 16 and 32."""

    stem_parts = ("conv1", "bn1")
    batch_norms: ClassVar[Mapping[str, str]] = {"conv1": "bn1"}

    def __init__(self, config: ResNetConfig) -> None:
        super().__init__()
        self.output_stages = config.output_stages
        width = config.width
        self.conv1 = nn.Conv2d(3, width, 7, stride=2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.pool = nn.MaxPool2d(3, stride=2, padding=1)
        self.stages, in_channels = nn.ModuleList(), width
        for number, blocks in enumerate(config.blocks[: max(config.output_stages)], 1):
            channels, deformable = width * 2 ** (number - 1), number in config.deformable_stages
            # The first bottleneck of a stage has the stride; the stem has that of the first stage.
            inputs = [(in_channels, 1 if number == 1 else 2)] + (blocks - 1) * [(4 * channels, 1)]
            stage = (Bottleneck(size, channels, stride, config.style, deformable) for size, stride in inputs)
            self.stages.append(Stage(*stage))
            in_channels = 4 * channels
        nn.init.kaiming_normal_(self.conv1.weight, mode="fan_out", nonlinearity="relu")

    def stem(self, images: Tensor) -> Tensor:
        """images: (B, 3, H, W) -> (B, width, H / 4, W / 4)."""
        # ReLU and max-pooling commute; the published order applies ReLU before pooling, to four times the cells.
        return F.relu(self.pool(self.bn1(self.conv1(images))))


class Bottleneck(nn.Module):
    """1x1, 3x3 and 1x1 convolution, each with batch norm, and a shortcut around them."""

    batch_norms: ClassVar[Mapping[str, str]] = {"conv1": "bn1", "conv2": "bn2", "conv3": "bn3"}

    def __init__(
        self, in_channels: int, channels: int, stride: int, style: Literal["pytorch", "caffe"], deformable: bool
    ) -> None:
        super().__init__()
        stride1, stride2 = (stride, 1) if style == "caffe" else (1, stride)
        self.conv1 = nn.Conv2d(in_channels, channels, 1, stride1, bias=False)
        self.bn1 = nn.BatchNorm2d(channels)
        self.conv2: nn.Module
        if deformable:
            self.conv2 = ModulatedDeformableConvolution(channels, channels, stride2)
        else:
            self.conv2 = nn.Conv2d(channels, channels, 3, stride2, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(channels)
        self.conv3 = nn.Conv2d(channels, 4 * channels, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(4 * channels)
        self.downsample: nn.Module = nn.Identity()
        if stride != 1 or in_channels != 4 * channels:
            shortcut = nn.Conv2d(in_channels, 4 * channels, 1, stride, bias=False)
            self.downsample = nn.Sequential(shortcut, nn.BatchNorm2d(4 * channels))
        for module in self.modules():
            if isinstance(module, nn.Conv2d) and module.bias is None:
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
        # An untrained block is the identity, so that deep networks train.
        nn.init.zeros_(self.bn3.weight)

    def forward(self, x: Tensor) -> Tensor:
        """x: (B, in_channels, H, W) -> (B, 4 · channels, H / stride, W / stride)."""
        y = F.relu(self.bn1(self.conv1(x)))
        y = F.relu(self.bn2(self.conv2(y)))
        return F.relu(self.bn3(self.conv3(y)) + self.downsample(x))


class BasicBlock(nn.Module):
    """The residual block of ResNet-18: two 3x3 convolutions, each with batch norm, and a shortcut around them."""

    batch_norms: ClassVar[Mapping[str, str]] = {"conv1": "bn1", "conv2": "bn2"}

    def __init__(self, in_channels: int, channels: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(in_channels, channels, 3, padding=1, bias=False)
        self.bn1 = nn.BatchNorm2d(channels)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(channels)
        self.downsample: nn.Module = nn.Identity()
        if in_channels != channels:
            shortcut = nn.Conv2d(in_channels, channels, 3, padding=1, bias=False)
            self.downsample = nn.Sequential(shortcut, nn.BatchNorm2d(channels))
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def forward(self, x: Tensor) -> Tensor:
        """x: (B, in_channels, Y, X) -> (B, channels, Y, X)."""
        y = F.relu(self.bn1(self.conv1(x)))
        return F.relu(self.bn2(self.conv2(y)) + self.downsample(x))
