"""NanoDet-g: an image backbone that is a whole detector of COCO's classes, with its batch norms folded.

NanoDet (RangiLyu 2020) with a CSP backbone of plain convolutions for GPUs, a path aggregation network of sums, and one
convolution as head a map. From its maps, one step gives boxes in the images: see `NanoDet.image_boxes`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from bevcli.model.backbone import Backbone
from bevcli.model.image_boxes import BINS, CANDIDATES, IMAGE_CLASSES, ImageBoxes, best_image_boxes

STEM_CHANNELS = 32
# Of each stage: input channels, blocks, stride. It doubles the channels.
STAGES = ((32, 1, 1), (64, 2, 2), (128, 2, 2), (256, 3, 2))
CHANNELS = 128  # of all maps of the pyramid and of the head
STRIDES = (8, 16, 32)  # pixels of the image per cell of these maps
SLOPE = 0.1  # of the leaky ReLU
PIXEL_MEAN, PIXEL_STD = (103.53, 116.28, 123.675), (57.375, 57.12, 58.395)  # B G R, as the detector was trained


@dataclass(frozen=True)
class NanoDetConfig:
    """The backbone."""

    title: ClassVar[str] = "NanoDet-g"

    kind: Literal["nanodet"] = "nanodet"  # chooses this backbone
    # the maps that go to the neck: the first ones of 1, 2 and 3, with strides 8, 16 and 32. The boxes in the images
    # take all three
    output_stages: tuple[int, ...] = (1, 2)
    frozen: bool = True  # whether the weights stay as they are in every training
    max_boxes: int = 48  # most boxes in an image
    overlap: float = 0.6  # intersection over union from which on two boxes of a class are one

    def __post_init__(self) -> None:
        if not self.output_stages or self.output_stages != (1, 2, 3)[: len(self.output_stages)]:
            raise ValueError("output_stages must be [1], [1, 2] or [1, 2, 3]")
        if not 1 <= self.max_boxes <= CANDIDATES or not 0 < self.overlap <= 1:
            raise ValueError(f"max_boxes must be from 1 to {CANDIDATES}, overlap above 0 and at most 1")

    def output_channels(self) -> tuple[int, ...]:
        """Channels of the map of each output stage."""
        return (CHANNELS,) * len(self.output_stages)

    def output_strides(self) -> tuple[int, ...]:
        """Pixels of the image per cell of the map of each output stage."""
        return STRIDES[: len(self.output_stages)]

    def stage_names(self) -> Iterator[str]:
        """Each stage in words."""
        for _, blocks, _ in STAGES:
            yield f"CSP block of {blocks} residual block{'s' * (blocks > 1)}"

    def build(self) -> "NanoDet":
        """The backbone, with random weights."""
        return NanoDet(self)


class NanoDet(Backbone):
    """See `NanoDetConfig`. Images are BGR, with `PIXEL_MEAN` and `PIXEL_STD`. A training keeps all of it, or nothing.

    Attributes:
        config: of the backbone.
        pan: the path aggregation network.
        head: from its maps to those of the backbone, and from these to the numbers of the boxes.
    """

    stem_parts = ("conv1",)

    def __init__(self, config: NanoDetConfig) -> None:
        super().__init__()
        self.config, self.output_stages = config, config.output_stages
        self.conv1 = LeakyConvolution(3, STEM_CHANNELS, 3, stride=2)
        self.stages = nn.ModuleList(CspBlock(*stage) for stage in STAGES)
        self.pan = PathAggregation([2 * channels for channels, *_ in STAGES[1:]])
        self.head = NanoDetHead()
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, SLOPE, nonlinearity="leaky_relu")
                nn.init.zeros_(module.bias)  # type: ignore[arg-type]
        self.freeze(0)

    def freeze(self, stages: int) -> None:
        """As `Backbone.freeze`. All of it is kept where one stage is, or where the configuration says so."""
        super().freeze(len(self.stages) if stages or self.config.frozen else 0)

    def _frozen_parts(self) -> Iterator[nn.Module]:
        yield from self.children() if self.frozen_stages else ()

    def forward(self, images: Tensor) -> list[Tensor]:
        """The three maps of the head, of which the neck takes the first.

        images: (B, 3, H, W), padded to multiples of 32 here -> (B, 128, H / stride, W / stride), strides 8, 16 and 32.
        """
        if self.frozen_maps is not None:
            return self.frozen_maps(images)
        height, width = images.shape[-2:]
        if height % STRIDES[-1] or width % STRIDES[-1]:
            images = F.pad(images, (0, -width % STRIDES[-1], 0, -height % STRIDES[-1]))
        x = F.max_pool2d(self.conv1(images), 3, stride=2, padding=1)
        maps: list[Tensor] = []
        for stage in self.stages:
            x = stage(x)
            maps.append(x)
        heads: list[Tensor] = self.head(self.pan(maps[1:]))
        return heads

    def image_boxes(self, maps: Sequence[Tensor], has_image: Tensor, sizes: Tensor | None = None) -> ImageBoxes:
        """The boxes of COCO's road users in the images, with gradients where the maps or the weights have them.

        Args:
            maps: of `forward`, for B·N images.
            has_image: (B, N) bool; the boxes of a camera without an image have the score 0.
            sizes: (B, N, 2) width and height of each image without its padding, pixels, to which boxes are clipped.
                Default: with the padding.
        """
        return best_image_boxes(
            maps, self.head.predict(maps), STRIDES, has_image, sizes, self.config.max_boxes, self.config.overlap
        )


class LeakyConvolution(nn.Conv2d):
    """A convolution that keeps the size, or halves it with stride 2, and a leaky ReLU."""

    def __init__(self, in_channels: int, out_channels: int, kernel_size: int, stride: int = 1) -> None:
        super().__init__(in_channels, out_channels, kernel_size, stride, padding=kernel_size // 2)

    def forward(self, x: Tensor) -> Tensor:
        """x: (B, in_channels, H, W) -> (B, out_channels, H / stride, W / stride)."""
        return F.leaky_relu(super().forward(x), SLOPE)


class TinyResBlock(nn.Module):
    """Two convolutions of half of the channels, whose results stand side by side."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.in_conv = LeakyConvolution(channels, channels // 2, 3)
        self.mid_conv = LeakyConvolution(channels // 2, channels // 2, 3)

    def forward(self, x: Tensor) -> Tensor:
        """x: (B, channels, H, W) -> the same shape."""
        x = self.in_conv(x)
        return torch.cat([self.mid_conv(x), x], 1)


class CspBlock(nn.Module):
    """A stage: blocks after a convolution, whose own result stands beside theirs (cross stage partial, CSPNet)."""

    def __init__(self, channels: int, blocks: int, stride: int) -> None:
        super().__init__()
        self.in_conv = LeakyConvolution(channels, channels, 3, stride)
        self.res_blocks = nn.Sequential(*(TinyResBlock(channels) for _ in range(blocks)))
        self.res_out_conv = LeakyConvolution(channels, channels, 3)

    def forward(self, x: Tensor) -> Tensor:
        """x: (B, channels, H, W) -> (B, 2 channels, H / stride, W / stride)."""
        x = self.in_conv(x)
        return torch.cat([self.res_out_conv(self.res_blocks(x)), x], 1)


class PathAggregation(nn.Module):
    """Sums of coarse maps into finer ones, and back (PANet), without convolutions between them."""

    def __init__(self, in_channels: Sequence[int]) -> None:
        super().__init__()
        self.lateral_convs = nn.ModuleList(nn.Conv2d(size, CHANNELS, 1) for size in in_channels)

    def forward(self, maps: Sequence[Tensor]) -> list[Tensor]:
        """maps: (B, in_channels, H, W), fine to coarse, each of half the even size of the last -> (B, 128, H, W)."""
        summed = [convolution(x) for convolution, x in zip(self.lateral_convs, maps, strict=True)]
        for i in range(len(summed) - 1, 0, -1):
            size = summed[i - 1].shape[-2:]
            summed[i - 1] = summed[i - 1] + F.interpolate(summed[i], size, mode="bilinear", align_corners=False)
        for i in range(1, len(summed)):
            summed[i] = summed[i] + F.avg_pool2d(summed[i - 1], 2)  # bilinear resizing to half is this mean
        return summed


class NanoDetHead(nn.Module):
    """Of each map a convolution, whose result is a map of the backbone, and a linear step from it to the boxes."""

    def __init__(self) -> None:
        super().__init__()
        self.cls_convs = nn.ModuleList(LeakyConvolution(CHANNELS, CHANNELS, 3) for _ in STRIDES)
        self.gfl_cls = nn.ModuleList(nn.Conv2d(CHANNELS, len(IMAGE_CLASSES) + 4 * BINS, 1) for _ in STRIDES)

    def forward(self, maps: Sequence[Tensor]) -> list[Tensor]:
        """maps: (B, 128, H, W) of the three strides -> the same shapes."""
        return [convolution(x) for convolution, x in zip(self.cls_convs, maps, strict=True)]

    def predict(self, maps: Sequence[Tensor]) -> list[Tensor]:
        """maps: of `forward` -> (B, 7 + 44, H, W): logits of `IMAGE_CLASSES`, then see `image_boxes.distances`."""
        dtype = next(self.gfl_cls.parameters()).dtype
        return [layer(x.to(dtype)) for layer, x in zip(self.gfl_cls, maps, strict=True)]
