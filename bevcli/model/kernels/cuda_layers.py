"""Layers of a model prepared for inference on a CUDA GPU that take fewer passes over the memory than the plain ones."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor, nn

from bevcli.geometry.bev_grid import BevGrid
from bevcli.model.deformable_attention import FeatureMaps
from bevcli.model.image_tokens import ImageTokens
from bevcli.model.resnet import Bottleneck
from bevcli.model.segmentation import (
    MaskDecoderLayer,
    SegmentationConfig,
    SegmentationHead,
    SegmentationOutputs,
    map_layers,
)


class FusedBottleneck(Bottleneck):
    """A `Bottleneck` with folded batch norms: cuDNN adds bias and shortcut, and applies ReLU, at once."""

    def fuse(self) -> None:
        """Moves the bias of the shortcut's convolution into the last one, in place, as both are added to the result."""
        if isinstance(self.downsample, nn.Sequential):
            shortcut = self.downsample[0]
            assert isinstance(shortcut, nn.Conv2d)
            assert shortcut.bias is not None
            assert self.conv3.bias is not None
            self.conv3.bias = nn.Parameter(self.conv3.bias + shortcut.bias, requires_grad=False)
            shortcut.bias = None

    def forward(self, x: Tensor) -> Tensor:
        """As `Bottleneck.forward`."""
        y = convolution_with_relu(self.conv1, x)
        y = convolution_with_relu(self.conv2, y)
        return convolution_with_relu(self.conv3, y, self.downsample(x))


def convolution_with_relu(convolution: nn.Module, x: Tensor, shortcut: Tensor | None = None) -> Tensor:
    """ReLU of the convolution of x plus the shortcut, which has the shape of the result."""
    if not isinstance(convolution, nn.Conv2d):
        assert shortcut is None
        result: Tensor = convolution(x)
        return result.relu_()
    assert not isinstance(convolution.padding, str)
    rest = convolution.stride, convolution.padding, convolution.dilation, convolution.groups
    if shortcut is None:
        return torch.cudnn_convolution_relu(x, convolution.weight, convolution.bias, *rest)
    return torch.cudnn_convolution_add_relu(x, convolution.weight, shortcut, 1.0, convolution.bias, *rest)


class TokensInOnePass(ImageTokens):
    """`ImageTokens`: each level is read once, and written to its place with both embeddings added."""

    def forward(self, maps: Sequence[Tensor], camera_index: Tensor) -> FeatureMaps:
        """As `ImageTokens.forward`."""
        images, channels = maps[0].shape[:2]
        levels = [x.flatten(2).transpose(1, 2) for x in maps]  # (B·N, S_l, C)
        tokens = maps[0].new_empty(images, sum(x.shape[1] for x in levels), channels)
        embedding = self.level_embedding[: len(maps), None]  # (L, 1, C)
        if self.camera_embedding is not None:
            of_cameras = self.camera_embedding[camera_index].reshape(-1, channels)  # (N, C) or (B·N, C)
            embedding = embedding + of_cameras.repeat(images // len(of_cameras), 1)  # (L, B·N, C)
        parts = tokens.split([x.shape[1] for x in levels], dim=1)
        for level, part, added in zip(levels, parts, embedding, strict=True):
            torch.add(level, added[:, None], out=part)
        return FeatureMaps(tokens, tuple((x.shape[-2], x.shape[-1]) for x in maps))


class AttentionByProducts(MaskDecoderLayer):
    """A `MaskDecoderLayer` with its table of attention weights in memory.

    With few queries and many keys this is faster: PyTorch's kernel gives each block of queries to one multiprocessor.
    """

    def attend(self, queries: Tensor, keys: Tensor, values: Tensor) -> Tensor:
        """As `MaskDecoderLayer.attend`."""
        scores = (queries * queries.shape[-1] ** -0.5) @ keys.transpose(-1, -2)
        return scores.softmax(-1) @ values


class MapOnDevice(SegmentationHead):
    """A `SegmentationHead`: the GPU merges the masks, so that neither masks are copied nor the CPU does it.

    Attributes:
        config: of the head.
        grid: of the BEV map.
    """

    config: SegmentationConfig
    grid: BevGrid

    def forward(self, bev: Tensor, position: Tensor) -> SegmentationOutputs:
        """As `SegmentationHead.forward`, for a batch of one, with map layers."""
        found = super().forward(bev, position)
        masks, classes = found.mask_logits[-1, 0].float(), found.class_logits[-1, 0].float()
        return replace(found, map_layers=map_layers(masks, classes, self.config, self.grid))
