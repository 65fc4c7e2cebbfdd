"""Layers run by oneDNN on a CPU, for inference: weights are packed once, ReLU and sums are fused into convolutions.

The operators are those that PyTorch's compiler uses for convolutions and linear layers. Where a build of PyTorch lacks
them, a model keeps its own layers.
"""

from __future__ import annotations

from typing import Any, Literal

import torch
from torch import Tensor, nn

from bevcli.model.bev_fusion import FusionBlock
from bevcli.model.feed_forward import FeedForward
from bevcli.model.resnet import Bottleneck


def has_onednn(dtype: torch.dtype) -> bool:
    """Whether this build of PyTorch and this CPU can run these layers in a dtype."""
    operators = ("_convolution_pointwise", "_linear_pointwise", "_reorder_linear_weight", "_is_mkldnn_bf16_supported")
    if not torch.backends.mkldnn.is_available() or not all(hasattr(torch.ops.mkldnn, name) for name in operators):
        return False
    return dtype == torch.float32 or (dtype == torch.bfloat16 and torch.ops.mkldnn._is_mkldnn_bf16_supported())


class PackedLinear(nn.Module):
    """A linear layer with its weight in oneDNN's own layout, and an activation in the same pass."""

    def __init__(self, layer: nn.Linear, activation: Literal["none", "relu", "gelu"] = "none") -> None:
        super().__init__()
        self.weight, self.bias = layer.weight, layer.bias
        self.packed = torch.ops.mkldnn._reorder_linear_weight(layer.weight)
        self.activation: tuple[str, list[float], str] = (activation, [], "none" if activation == "gelu" else "")

    def forward(self, x: Tensor) -> Tensor:
        """x: (..., in) -> (..., out)."""
        return torch.ops.mkldnn._linear_pointwise(x, self.packed, self.bias, *self.activation)


class ActivatedConvolution(nn.Module):
    """relu(convolution(x)), or relu(convolution(x) + shortcut), in one pass."""

    def __init__(self, convolution: nn.Conv2d) -> None:
        super().__init__()
        self.weight, self.bias = convolution.weight, convolution.bias
        self.geometry = (list(convolution.padding), list(convolution.stride), list(convolution.dilation), 1)

    def forward(self, x: Tensor, shortcut: Tensor | None = None) -> Tensor:
        """x: (B, in, H, W), shortcut: (B, out, H', W') -> (B, out, H', W')."""
        convolve: Any = torch.ops.mkldnn._convolution_pointwise
        if shortcut is None:
            return convolve(x, self.weight, self.bias, *self.geometry, "relu", [], "")
        return convolve.binary(x, shortcut, self.weight, self.bias, *self.geometry, "add", 1.0, "relu", [], "")


class FusedBottleneck(nn.Module):
    """A `Bottleneck` whose batch norms are folded."""

    def __init__(self, block: Bottleneck) -> None:
        super().__init__()
        assert isinstance(block.conv1, nn.Conv2d)
        self.conv1, self.conv3 = ActivatedConvolution(block.conv1), ActivatedConvolution(block.conv3)
        if isinstance(block.conv2, nn.Conv2d):
            self.conv2: nn.Module = ActivatedConvolution(block.conv2)
        else:
            self.conv2 = nn.Sequential(block.conv2, nn.ReLU(inplace=True))  # a deformable convolution
        self.downsample = block.downsample

    def forward(self, x: Tensor) -> Tensor:
        """As `Bottleneck.forward`."""
        return self.conv3(self.conv2(self.conv1(x)), self.downsample(x))


class FusedFusionBlock(nn.Module):
    """A `FusionBlock` whose batch norms are folded."""

    def __init__(self, block: FusionBlock) -> None:
        super().__init__()
        self.conv1, self.conv2 = ActivatedConvolution(block.conv1), ActivatedConvolution(block.conv2)
        self.downsample = block.downsample

    def forward(self, x: Tensor) -> Tensor:
        """As `FusionBlock.forward`."""
        return self.conv2(self.conv1(x), self.downsample(x))


def use_onednn(part: nn.Module) -> None:
    """Replaces the linear layers and the residual blocks of a module, in place. Batch norms must be folded already."""
    for name, child in part.named_children():
        if isinstance(child, Bottleneck) and has_onednn(child.conv1.weight.dtype):
            child = FusedBottleneck(child)
            setattr(part, name, child)
        elif isinstance(child, FusionBlock) and has_onednn(child.conv1.weight.dtype):
            child = FusedFusionBlock(child)
            setattr(part, name, child)
        if isinstance(child, FeedForward) and has_onednn(child.expand.weight.dtype):
            both = PackedLinear(child.expand, child.activation), PackedLinear(child.reduce)
            setattr(part, name, nn.Sequential(*both))  # dropout has no effect in inference
        # Not the subclass of nn.Linear in multi-head attention, which reads the weight of that layer itself.
        elif type(child) is nn.Linear and has_onednn(child.weight.dtype):
            setattr(part, name, PackedLinear(child))
        else:
            use_onednn(child)
