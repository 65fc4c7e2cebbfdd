"""The fastest parts for a device, in the place of the plain ones: kernels, memory layout, folded batch norms."""

from importlib.util import find_spec

import torch
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_weights

from bevcli.model.deformable_attention import DeformableAttention, GridSampling
from bevcli.model.deformable_convolution import ModulatedDeformableConvolution
from bevcli.model.kernels.compiled import CompiledDeformableConvolution, CompiledSampling
from bevcli.model.resnet import BasicBlock, Bottleneck, ResNet
from bevcli.model.temporal_model import TemporalModel
from bevcli.model.upload import Tables

VECTORISED = 16  # elements from which on PyTorch's own softmax is faster


def choose_kernels(model: TemporalModel, device: torch.device, *, gradients: bool = False) -> None:
    """Gives a model, in place, the memory layout and the deformable attention that are fastest on a device.

    gradients: whether the model is trained; then only kernels with gradients are used.
    """
    for part in model.convolutional_parts:
        part.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    tables = Tables()
    for module in model.modules():
        if isinstance(module, DeformableAttention):
            module.sampling = fastest_sampling(device, tables, gradients=gradients)
            if not gradients:
                module.level_sizes = tables.level_sizes
            if not gradients and device.type == "cpu":
                module.softmax = softmax_of_few


def fastest_sampling(device: torch.device, tables: Tables, *, gradients: bool = False) -> nn.Module:
    """The fastest module for `DeformableAttention.sampling` on a device.

    Args:
        device: CPU, GPU or another one, such as "mps", which gets the plain module.
        tables: shared by the modules of a model.
        gradients: whether the module needs them.
    """
    if device.type == "cpu":
        return CompiledSampling()
    if device.type == "cuda" and find_spec("triton") and not gradients:
        from bevcli.model.kernels.triton_attention import TritonSampling  # only where Triton is installed

        return TritonSampling(tables)
    return GridSampling()


def softmax_of_few(logits: Tensor) -> Tensor:
    """Softmax over the last axis. On a CPU that of PyTorch takes ten times as long where this has 4 or 8 elements."""
    if logits.shape[-1] >= VECTORISED:
        return logits.softmax(-1)
    exponentials = (logits - logits.amax(-1, keepdim=True)).exp_()
    return exponentials.div_(exponentials.sum(-1, keepdim=True))


def fold_batch_norms(model: nn.Module, device: torch.device) -> None:
    """Folds every batch norm into the convolution before it, in place, for inference on a device."""
    for block in model.modules():
        if isinstance(block, ResNet):
            _fold(block, "conv1", "bn1", device)
        if isinstance(block, Bottleneck | BasicBlock):
            for number in (1, 2, 3) if isinstance(block, Bottleneck) else (1, 2):
                _fold(block, f"conv{number}", f"bn{number}", device)
            if isinstance(block.downsample, nn.Sequential):
                _fold(block.downsample, "0", "1", device)


def _fold(parent: nn.Module, convolution_name: str, norm_name: str, device: torch.device) -> None:
    convolution, norm = parent.get_submodule(convolution_name), parent.get_submodule(norm_name)
    assert isinstance(convolution, nn.Conv2d | ModulatedDeformableConvolution)
    assert isinstance(norm, nn.BatchNorm2d)
    assert norm.running_mean is not None
    assert norm.running_var is not None
    convolution.weight, bias = fuse_conv_bn_weights(
        convolution.weight, None, norm.running_mean, norm.running_var, norm.eps, norm.weight, norm.bias
    )
    parent.set_submodule(norm_name, nn.Identity())
    if isinstance(convolution, nn.Conv2d):
        convolution.bias = bias
    elif device.type == "cpu":
        parent.set_submodule(convolution_name, CompiledDeformableConvolution(convolution, bias))
    else:
        parent.set_submodule(convolution_name, BiasedDeformableConvolution(convolution, bias))


class BiasedDeformableConvolution(nn.Module):
    """A deformable convolution with the bias that is left of a batch norm folded into it."""

    def __init__(self, convolution: ModulatedDeformableConvolution, bias: Tensor) -> None:
        super().__init__()
        self.convolution = convolution
        self.bias = nn.Parameter(bias.detach(), requires_grad=False)

    def forward(self, x: Tensor) -> Tensor:
        """x: (B, C, H, W) -> (B, O, H', W')."""
        return self.convolution(x) + self.bias[:, None, None]
