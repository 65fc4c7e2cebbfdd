"""The fastest parts for a device, in the place of the plain ones: kernels, memory layout, folded batch norms."""

from functools import cache
from importlib.util import find_spec
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_weights

from bevcli.model.deformable_attention import DeformableAttention, GridSampling, level_sizes
from bevcli.model.deformable_convolution import (
    Convolve,
    ModulatedDeformableConvolution,
    predicted_deformable_convolution,
)
from bevcli.model.kernels.compiled import CompiledDeformableConvolution, CompiledSampling, sample_hits
from bevcli.model.network import Network
from bevcli.model.temporal_model import TemporalModel

VECTORISED = 16  # elements from which on PyTorch's own softmax is faster


def choose_kernels(model: TemporalModel, device: torch.device, *, gradients: bool = False) -> None:
    """Gives a model, in place, the memory layout and the deformable operations that are fastest on a device.

    gradients: whether the model is trained; then only kernels with gradients are used.
    """
    if isinstance(model, Network):
        model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    kept_sizes = cache(level_sizes)  # all: CUDA graphs hold their addresses
    for module in model.modules():
        if isinstance(module, DeformableAttention):
            module.sampling = fastest_sampling(device)
            if not gradients:
                module.level_sizes = kept_sizes
            if not gradients and device.type == "cpu":
                module.softmax, module.sample_hits = softmax_of_few, sample_hits
            elif not gradients and has_triton(device):
                from bevcli.model.kernels import triton_attention  # only where Triton is installed

                module.sample_hits = triton_attention.sample_hits
        elif isinstance(module, ModulatedDeformableConvolution):
            module.convolve = fastest_convolution(device)


def has_triton(device: torch.device) -> bool:
    """Whether Triton's kernels run on the device."""
    return device.type == "cuda" and find_spec("triton") is not None


def fastest_convolution(device: torch.device) -> Convolve:
    """The fastest function for `ModulatedDeformableConvolution.convolve` on a device, with gradients."""
    if has_triton(device):
        from bevcli.model.kernels.triton_convolution import deformable_convolution  # only where Triton is installed

        return deformable_convolution
    return predicted_deformable_convolution


def fastest_sampling(device: torch.device) -> nn.Module:
    """The fastest module for `DeformableAttention.sampling` on a device. Devices such as "mps" get the plain module."""
    if device.type == "cpu":
        return CompiledSampling()
    if has_triton(device):
        from bevcli.model.kernels.triton_attention import TritonSampling  # only where Triton is installed

        return TritonSampling()
    return GridSampling()


def softmax_of_few(logits: Tensor) -> Tensor:
    """Softmax over the last axis. On a CPU that of PyTorch takes ten times as long where this has 4 or 8 elements."""
    if logits.shape[-1] >= VECTORISED:
        return logits.softmax(-1)
    exponentials = (logits - logits.amax(-1, keepdim=True)).exp_()
    return exponentials.div_(exponentials.sum(-1, keepdim=True))


def fold_batch_norms(model: nn.Module, device: torch.device) -> None:
    """Folds every batch norm into the convolution before it, in place, for inference on a device."""
    for parent in list(model.modules()):
        for (name, convolution), (norm_name, norm) in pairwise(list(parent.named_children())):
            if not isinstance(norm, nn.BatchNorm2d):
                continue
            assert isinstance(convolution, nn.Conv2d | ModulatedDeformableConvolution)
            assert norm.running_mean is not None
            assert norm.running_var is not None
            convolution.weight, bias = fuse_conv_bn_weights(
                convolution.weight, None, norm.running_mean, norm.running_var, norm.eps, norm.weight, norm.bias
            )
            parent.set_submodule(norm_name, nn.Identity())
            convolution.bias = bias
            if device.type == "cpu" and isinstance(convolution, ModulatedDeformableConvolution):
                parent.set_submodule(name, CompiledDeformableConvolution(convolution))
