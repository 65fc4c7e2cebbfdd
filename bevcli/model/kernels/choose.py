"""The fastest parts for a device, in the place of the plain ones: kernels, memory layout, folded batch norms.

The attentions of the encoder run one kernel for all hits, without tables of locations and weights. Parts that see only
calibration, poses and sizes keep the result of the last call.
"""

from collections.abc import Mapping
from importlib.util import find_spec
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_weights

from bevcli.model.deformable_attention import DeformableAttention, GridSampling, SampleHits
from bevcli.model.deformable_convolution import ModulatedDeformableConvolution
from bevcli.model.encoder import SpatialCrossAttention, TemporalSelfAttention
from bevcli.model.horizon import Ring
from bevcli.model.image_tokens import CalibrationEmbedding
from bevcli.model.kernels.compiled import CompiledDeformableConvolution, CompiledSampling, sample_hits
from bevcli.model.network import Network
from bevcli.model.pillar_projection import Pillars

Kinds = Mapping[type[nn.Module], type[nn.Module]]
BY_HITS = (TemporalSelfAttention, SpatialCrossAttention)


def change_classes(model: nn.Module, classes: Kinds, **attributes: Any) -> None:
    """Makes modules of exactly these classes ones of others, in place, mostly of faster subclasses.

    No constructor runs: a module keeps its parameters, parts and settings. attributes: that the other classes need too.
    """
    for module in model.modules():
        if type(module) in classes:
            module.__class__ = classes[type(module)]
            vars(module).update(attributes)


def choose_kernels(model: nn.Module, device: torch.device) -> None:
    """Gives a model, in place, the memory layout and the deformable operations that are fastest on a device.

    They have no gradients; `choose_training_kernels` chooses those of a training.
    """
    if isinstance(model, Network):
        model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    sampling: type[GridSampling] = GridSampling
    kernel: SampleHits | None = None
    if device.type == "cpu":
        sampling, kernel = CompiledSampling, sample_hits
    elif has_triton(device):
        attention, convolution = triton_kernels()
        sampling, kernel = attention.TritonSampling, attention.sample_hits
        change_classes(model, {ModulatedDeformableConvolution: convolution.TritonDeformableConvolution})
    attentions = [module for module in model.modules() if isinstance(module, DeformableAttention)]
    for module in attentions:
        module.sampling = sampling(keeps_sizes=True)
    # Those with many queries; on a GPU all, where each kernel of its own takes time to launch.
    encoder = [module.attention for module in model.modules() if isinstance(module, BY_HITS)]
    for module in encoder if device.type == "cpu" else attentions:
        module.sampling.sample_hits = kernel


def has_triton(device: torch.device) -> bool:
    """Whether Triton's kernels run on the device."""
    return device.type == "cuda" and find_spec("triton") is not None


def triton_kernels() -> tuple[Any, Any]:
    """The modules of kernels for attention and for convolution. They need Triton."""
    from bevcli.model.kernels import triton_attention, triton_convolution

    return triton_attention, triton_convolution


def fold_batch_norms(model: nn.Module, device: torch.device) -> None:
    """Folds batch norms into the convolutions before them, in place, for inference on a device: see `Backbone`."""
    for parent in list(model.modules()):
        for name, norm_name in _batch_norms(parent):
            convolution, norm = map(parent.get_submodule, (name, norm_name))
            if type(norm) is not nn.BatchNorm2d or norm.running_mean is None or norm.running_var is None:
                continue
            if type(convolution) is not nn.Conv2d and not getattr(convolution, "folds_batch_norm", False):
                continue
            folded: Any = convolution
            folded.weight, folded.bias = fuse_conv_bn_weights(
                folded.weight, folded.bias, norm.running_mean, norm.running_var, norm.eps, norm.weight, norm.bias
            )
            parent.set_submodule(norm_name, nn.Identity())
            if device.type == "cpu" and not isinstance(convolution, nn.Conv2d):  # a deformable one
                parent.set_submodule(name, CompiledDeformableConvolution(folded))


def _batch_norms(parent: nn.Module) -> list[tuple[str, str]]:
    """Names of convolutions, or of what else stands there, and of the batch norms that alone take their results."""
    children = [name for name, _ in parent.named_children()]
    if isinstance(parent, nn.Sequential) and type(parent).forward is nn.Sequential.forward:
        return list(pairwise(children))
    pairs = getattr(parent, "batch_norms", {}).items()
    return [(name, norm) for name, norm in pairs if name in children and norm in children]


class LastCall(nn.Module):
    """Of a part that sees only calibration, poses and sizes: it keeps the result of the last call.

    It computes again only where its arguments are not those of that call. The comparison needs no wait for a GPU where
    the tensors are on the CPU.
    """

    _arguments: tuple[Any, ...] = ()
    _result: Any

    def forward(self, *arguments: Any) -> Any:
        """As the part's own `forward`."""
        if not self._arguments or not all(
            now.shape == last.shape and now.device == last.device and torch.equal(now, last)
            if isinstance(now, Tensor)
            else now == last
            for now, last in zip(arguments, self._arguments, strict=True)
        ):
            self._arguments = tuple(now.clone() if isinstance(now, Tensor) else now for now in arguments)
            self._result = super().forward(*arguments)
        return self._result


class KeptPillars(LastCall, Pillars):
    """`Pillars` that find the hits anew where the cameras have moved."""


class KeptRing(LastCall, Ring):
    """A `Ring` that looks anew where the cameras have moved."""


class KeptCalibrationEmbedding(LastCall, CalibrationEmbedding):
    """A `CalibrationEmbedding` that computes anew where the cameras have moved."""
