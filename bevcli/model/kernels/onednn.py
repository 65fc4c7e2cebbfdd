"""Layers run by oneDNN on a CPU, for inference: weights are packed once, ReLU and sums are fused into convolutions.

A residual block adds its last convolution to the shortcut in place: with few channels such a convolution mostly waits
for memory. No public operator packs weights or fuses sums, so these are the private ones that PyTorch's compiler uses;
where a build of PyTorch lacks them, a model keeps its own layers.
"""

from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor, nn

from bevcli.model.backbone import Stage
from bevcli.model.decoder import RegressionBranch
from bevcli.model.efficientnet_lite import InvertedResidual, SameConvolution
from bevcli.model.encoder import FeedForward
from bevcli.model.kernels import rounded_products
from bevcli.model.nanodet import SLOPE, LeakyConvolution
from bevcli.model.resnet import BasicBlock, Bottleneck

Activation = Literal["none", "relu", "relu6", "leaky"]
# What oneDNN calls an activation, with its numbers.
ACTIVATIONS: dict[Activation, tuple[str, list[float]]] = {
    "none": ("none", []),
    "relu": ("relu", []),
    "relu6": ("hardtanh", [0.0, 6.0]),
    "leaky": ("leaky_relu", [SLOPE]),
}
OPERATORS = (
    "_convolution_pointwise",
    "_convolution_pointwise_",
    "_is_mkldnn_bf16_supported",
    "_linear_pointwise",
    "_reorder_convolution_weight",
    "_reorder_linear_weight",
)


def has_onednn(dtype: torch.dtype) -> bool:
    """This build of PyTorch and this CPU can run these layers in a dtype."""
    if not torch.backends.mkldnn.is_available() or not all(hasattr(torch.ops.mkldnn, name) for name in OPERATORS):
        return False
    return dtype == torch.float32 or (dtype == torch.bfloat16 and torch.ops.mkldnn._is_mkldnn_bf16_supported())


def has_matrix_unit() -> bool:
    """This CPU multiplies matrices of bfloat16 in a unit of its own (AMX), and this build of PyTorch can use it."""
    can_round = hasattr(torch.backends.mkldnn, "matmul") and has_onednn(torch.bfloat16)
    return can_round and torch.cpu._is_amx_tile_supported()  # PyTorch tells of AMX in no other way


class PackedLinear(nn.Module):
    """A linear layer with its weight in oneDNN's own layout, and an activation in the same pass."""

    def __init__(
        self, layer: nn.Linear, activation: Literal["none", "relu", "gelu"] = "none", *, rounds: bool = False
    ) -> None:
        """rounds: compute in `rounded_products`."""
        super().__init__()
        self.rounds = rounds
        self.weight, self.bias = layer.weight, layer.bias
        self.packed = torch.ops.mkldnn._reorder_linear_weight(layer.weight)
        self.activation: tuple[str, list[float], str] = (activation, [], "none" if activation == "gelu" else "")

    def forward(self, x: Tensor) -> Tensor:
        """x: (..., in) -> (..., out)."""
        with rounded_products("cpu", enabled=self.rounds):
            return torch.ops.mkldnn._linear_pointwise(x, self.packed, self.bias, *self.activation)


class PackedConvolution(nn.Module):
    """A convolution with its weight in the layout that oneDNN wants for the size of its input, and an activation."""

    packed: Tensor

    def __init__(self, convolution: nn.Conv2d, activation: Activation = "none") -> None:
        super().__init__()
        self.weight, self.bias, self.activation = convolution.weight, convolution.bias, ACTIVATIONS[activation]
        self.after_sum = None if activation == "none" else activation
        geometry = convolution.padding, convolution.stride, convolution.dilation
        self.geometry = (*map(list, geometry), convolution.groups)
        self.packed_for: torch.Size | None = None

    def forward(self, x: Tensor, shortcut: Tensor | None = None) -> Tensor:
        """x: (B, in, H, W) -> (B, out, H', W'), channels last.

        With a shortcut: activation(convolution(x) + shortcut), in the memory of the shortcut.
        """
        if self.packed_for != x.shape:
            pack = torch.ops.mkldnn._reorder_convolution_weight
            self.packed, self.packed_for = pack(self.weight.detach(), *self.geometry, list(x.shape)), x.shape
        arguments = x, self.packed, self.bias, *self.geometry
        if shortcut is None:
            return torch.ops.mkldnn._convolution_pointwise(*arguments, *self.activation, "")
        add = torch.ops.mkldnn._convolution_pointwise_.binary
        return add(shortcut, *arguments, "add", 1.0, self.after_sum, [], "")


class PackedSameConvolution(PackedConvolution):
    """A `SameConvolution` in oneDNN."""

    def __init__(self, convolution: SameConvolution, activation: Activation = "none") -> None:
        super().__init__(convolution, activation)
        self.padding_for = convolution.padding_for

    def forward(self, x: Tensor, shortcut: Tensor | None = None) -> Tensor:
        """x: (B, in, H, W) -> (B, out, H / 2, W / 2), rounded up, channels last. There is no shortcut."""
        padding, rows, columns = self.padding_for(x)
        self.geometry = (padding, *self.geometry[1:])
        return super().forward(x)[..., rows:, columns:]


class FusedInvertedResidual(nn.Module):
    """An `InvertedResidual` whose batch norms are folded."""

    def __init__(self, block: InvertedResidual, *, overwrites: bool) -> None:
        """overwrites: where it adds x, the result is written over x."""
        super().__init__()
        wide = [layer for layer in (block.expand, block.depthwise) if layer is not None]
        self.wide = nn.Sequential()
        for layer in wide:
            if isinstance(layer, SameConvolution):
                self.wide.append(PackedSameConvolution(layer, "relu6"))
            else:
                self.wide.append(PackedConvolution(layer, "relu6"))
        self.project, self.adds, self.overwrites = PackedConvolution(block.project), block.adds, overwrites

    def forward(self, x: Tensor) -> Tensor:
        """As the block's own `forward`."""
        y = self.wide(x)
        return self.project(y, None if not self.adds else x if self.overwrites else x.clone())


class FusedBlock(nn.Module):
    """A `Bottleneck` or a `BasicBlock` whose batch norms are folded."""

    def __init__(self, block: Bottleneck | BasicBlock, *, overwrites: bool) -> None:
        """overwrites: without a `downsample` the result is written over the input."""
        super().__init__()
        *first, last = [child for name, child in block.named_children() if name.startswith("conv")]
        self.first = nn.Sequential()
        for convolution in first:
            if isinstance(convolution, nn.Conv2d):
                self.first.append(PackedConvolution(convolution, "relu"))
            else:  # a `CompiledDeformableConvolution`, whose result is a linear layer's
                product = convolution.get_submodule("product")
                assert isinstance(product, nn.Linear)
                convolution.set_submodule("product", PackedLinear(product, "relu"))
                self.first.append(convolution)
        assert isinstance(last, nn.Conv2d)
        self.last, self.downsample, self.overwrites = PackedConvolution(last, "relu"), block.downsample, overwrites

    def forward(self, x: Tensor) -> Tensor:
        """As the block's own `forward`."""
        y, shortcut = self.first(x), self.downsample(x)
        return self.last(y, shortcut if self.overwrites or shortcut is not x else x.clone())


def use_onednn(module: nn.Module, *, rounds: bool = False) -> None:
    """Replaces convolutions, linear layers and residual blocks of a module, in place, for inference.

    Batch norms must be folded already; a block with a batch norm of its own stays as it is. A block may write over its
    input within a `Stage`. rounds: linear layers of float32 compute in `rounded_products`, except for those that
    predict positions: boxes would move.
    """
    pending = [(module, rounds)]
    while pending:
        parent, rounds_parent = pending.pop()
        for index, (name, child) in enumerate(parent.named_children()):
            rounds_child = rounds_parent and name != "reference_points" and not isinstance(child, RegressionBranch)
            fast = child
            parameter = next(child.parameters(), None)
            if parameter is None or not has_onednn(parameter.dtype):
                pass
            elif type(child) in BLOCKS and not any(isinstance(norm, nn.BatchNorm2d) for norm in child.modules()):
                fast = BLOCKS[type(child)](child, overwrites=isinstance(parent, Stage) and index > 0)
            elif isinstance(child, FeedForward):  # dropout has no effect in inference
                expand = PackedLinear(child.expand, child.activation, rounds=rounds_child)
                fast = nn.Sequential(expand, PackedLinear(child.reduce, rounds=rounds_child))
            elif type(child) is SameConvolution:
                fast = PackedSameConvolution(child)
            elif type(child) is nn.Conv2d and child.padding_mode == "zeros" and not isinstance(child.padding, str):
                fast = PackedConvolution(child)
            elif type(child) is LeakyConvolution:
                fast = PackedConvolution(child, "leaky")
            # Not subclasses, such as the layer in multi-head attention whose weight is read by its owner.
            elif type(child) is nn.Linear:
                fast = PackedLinear(child, rounds=rounds_child)
            setattr(parent, name, fast)
            pending.append((fast, rounds_child))


BLOCKS: dict[type[nn.Module], Callable[..., nn.Module]] = {
    Bottleneck: FusedBlock,
    BasicBlock: FusedBlock,
    InvertedResidual: FusedInvertedResidual,
}
