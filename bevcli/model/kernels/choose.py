"""The fastest parts for a device, in the place of the plain ones: kernels, memory layout, folded batch norms."""

from functools import cache
from importlib.util import find_spec
from itertools import pairwise
from typing import Any, TypeVar

import torch
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_weights

from bevcli.model.deformable_attention import DeformableAttention, GridSampling, level_sizes
from bevcli.model.deformable_convolution import ModulatedDeformableConvolution
from bevcli.model.encoder import SpatialCrossAttention, TemporalSelfAttention
from bevcli.model.kernels.by_hits import AttentionByHits, SpatialByHits, TemporalByHits
from bevcli.model.kernels.compiled import CompiledDeformableConvolution, CompiledSampling, sample_hits
from bevcli.model.network import Network

VECTORISED = 16  # elements from which on PyTorch's own softmax is faster
Kind = TypeVar("Kind", bound=nn.Module)


def in_place_of(plain: nn.Module, kind: type[Kind], **attributes: Any) -> Kind:
    """A module of another class, mostly a faster subclass, with the parameters, parts and settings of the plain one."""
    fast = kind.__new__(kind)
    vars(fast).update(vars(plain), **attributes)
    return fast


def choose_kernels(model: nn.Module, device: torch.device, *, gradients: bool = False) -> None:
    """Gives a model, in place, the memory layout and the deformable operations that are fastest on a device.

    model: not itself one of the operations. gradients: whether the model is trained; then only kernels with gradients
    are used.
    """
    if isinstance(model, Network):
        model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    functions: dict[str, Any] = {}
    if not gradients:
        functions["level_sizes"] = cache(level_sizes)  # CUDA graphs hold the addresses of the tables
        functions |= {"softmax": softmax_of_few} if device.type == "cpu" else {}
    for module in list(model.modules()):
        if isinstance(module, DeformableAttention):
            sampling = fastest_sampling(device)
            module.sampling = in_place_of(sampling, type(sampling), **functions)
    if has_triton(device):
        from bevcli.model.kernels.triton_convolution import TritonDeformableConvolution  # where Triton is installed

        for name, module in list(model.named_modules()):
            if isinstance(module, ModulatedDeformableConvolution):
                model.set_submodule(name, in_place_of(module, TritonDeformableConvolution))
    if not gradients:
        _choose_attentions(model, device)


def _choose_attentions(model: nn.Module, device: torch.device) -> None:
    kernel = sample_hits
    kinds: dict[type[nn.Module], type[nn.Module]]
    kinds = {TemporalSelfAttention: TemporalByHits, SpatialCrossAttention: SpatialByHits}
    if has_triton(device):
        from bevcli.model.kernels import triton_attention  # only where Triton is installed

        kernel, kinds = triton_attention.sample_hits, {**kinds, DeformableAttention: AttentionByHits}
    elif device.type != "cpu":
        return
    for name, module in list(model.named_modules()):
        if type(module) in kinds:
            model.set_submodule(name, in_place_of(module, kinds[type(module)], sample_hits=kernel))


def has_triton(device: torch.device) -> bool:
    """Whether Triton's kernels run on the device."""
    return device.type == "cuda" and find_spec("triton") is not None


def fastest_sampling(device: torch.device) -> GridSampling:
    """The fastest module for `DeformableAttention.sampling` on a device, with gradients; the plain one for "mps"."""
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
