"""The fastest parts for a device, in the place of the plain ones: kernels, memory layout, folded batch norms.

The attentions of the encoder run one kernel for all hits, without tables of locations and weights. Parts that see only
calibration, poses and sizes keep the result of the last call.
"""

from collections.abc import Callable
from functools import cache
from importlib.util import find_spec
from itertools import pairwise
from typing import Any, TypeVar

import torch
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_weights

from bevcli.model.deformable_attention import DeformableAttention, FeatureMaps, GridSampling, LevelShapes, level_sizes
from bevcli.model.encoder import SpatialCrossAttention, TemporalSelfAttention
from bevcli.model.image_tokens import CalibrationEmbedding
from bevcli.model.kernels.compiled import CompiledDeformableConvolution, CompiledSampling, Hits, sample_hits
from bevcli.model.network import Network
from bevcli.model.pillar_projection import PillarHits, Pillars

VECTORISED = 16  # elements from which on PyTorch's own softmax is faster
Kind = TypeVar("Kind", bound=nn.Module)
Kinds = dict[type[nn.Module], type[nn.Module]]
SampleHits = Callable[[Tensor, LevelShapes, Hits, Tensor, Tensor], Tensor]
"""The weighted sums (M, C) float32 of hits, without gradients: see `bevcli.model.kernels.compiled.sample_hits`."""


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
        functions |= {"weights": softmax_of_few} if device.type == "cpu" else {}
    by_hits: Kinds = {TemporalSelfAttention: TemporalByHits, SpatialCrossAttention: SpatialByHits}
    kinds: Kinds = {}
    sampling: type[GridSampling] = GridSampling
    kernel = sample_hits
    if device.type == "cpu":
        sampling, kinds = CompiledSampling, {} if gradients else by_hits
    elif has_triton(device):
        from bevcli.model.deformable_convolution import ModulatedDeformableConvolution
        from bevcli.model.kernels import triton_attention, triton_convolution  # only where Triton is installed

        sampling, kernel = triton_attention.TritonSampling, triton_attention.sample_hits
        kinds = {} if gradients else {**by_hits, DeformableAttention: AttentionByHits}
        for name, module in list(model.named_modules()):
            if isinstance(module, ModulatedDeformableConvolution):
                model.set_submodule(name, in_place_of(module, triton_convolution.TritonDeformableConvolution))
    for name, module in list(model.named_modules()):
        if isinstance(module, DeformableAttention):
            module.sampling = in_place_of(sampling(), sampling, **functions)
        if kind := kinds.get(type(module)):
            model.set_submodule(name, in_place_of(module, kind, sample_hits=kernel))


def has_triton(device: torch.device) -> bool:
    """Whether Triton's kernels run on the device."""
    return device.type == "cuda" and find_spec("triton") is not None


def softmax_of_few(logits: Tensor) -> Tensor:
    """As `GridSampling.weights`. On a CPU, PyTorch's softmax takes ten times as long for 4 or 8 samples."""
    flat = logits.flatten(-2)
    if flat.shape[-1] >= VECTORISED:
        return flat.softmax(-1).view_as(logits)
    exponentials = (flat - flat.amax(-1, keepdim=True)).exp_()
    return exponentials.div_(exponentials.sum(-1, keepdim=True)).view_as(logits)


def fold_batch_norms(model: nn.Module, device: torch.device) -> None:
    """Folds every batch norm into the convolution before it, in place, for inference on a device."""
    for parent in list(model.modules()):
        children: list[tuple[str, Any]] = list(parent.named_children())
        for (name, convolution), (norm_name, norm) in pairwise(children):
            if not isinstance(norm, nn.BatchNorm2d):
                continue
            assert norm.running_mean is not None
            assert norm.running_var is not None
            convolution.weight, convolution.bias = fuse_conv_bn_weights(
                convolution.weight, None, norm.running_mean, norm.running_var, norm.eps, norm.weight, norm.bias
            )
            parent.set_submodule(norm_name, nn.Identity())
            if device.type == "cpu" and not isinstance(convolution, nn.Conv2d):  # a deformable one
                parent.set_submodule(name, CompiledDeformableConvolution(convolution))


class TemporalByHits(TemporalSelfAttention):
    """A `TemporalSelfAttention` whose cells hit the history and the current map."""

    sample_hits: SampleHits

    def sample(self, bev_maps: Tensor, reference_points: Tensor, offsets: Tensor, logits: Tensor) -> Tensor:
        """As `TemporalSelfAttention.sample`."""
        (batch, cells), maps = offsets.shape[:2], bev_maps.shape[1]
        values = self.attention.values(bev_maps.flatten(0, 1))
        query, prediction = map_queries(batch, 2, cells, reference_points.device)
        points = reference_points.expand(batch, -1, -1, -1).reshape(-1, 1, 2)
        hits = Hits(query, points, [2 * cells // maps] * (maps * batch), prediction)
        sampled = self.sample_hits(values, self.level_shapes, hits, offsets.flatten(0, 1), logits.flatten(0, 1))
        return self.mean(sampled.unflatten(0, (batch, 2, cells)))


class SpatialByHits(SpatialCrossAttention):
    """A `SpatialCrossAttention` whose hits are those of the pillars."""

    sample_hits: SampleHits

    def sample(self, query: Tensor, image_features: FeatureMaps, hits: PillarHits) -> Tensor:
        """As `SpatialCrossAttention.sample`."""
        predicted = self.attention.predict(query.flatten(0, 1))  # (B·Y·X, heads, 1, …) each
        values = self.attention.values(image_features.tokens)
        by_map = Hits(hits.cell, hits.reference_points, hits.hits_per_camera, torch.zeros_like(hits.cell))
        return self.sample_hits(values, image_features.level_shapes, by_map, *predicted)


class AttentionByHits(DeformableAttention):
    """A `DeformableAttention` whose queries hit the one map around their reference points."""

    sample_hits: SampleHits

    def attend(self, query: Tensor, reference_points: Tensor, tokens: Tensor, level_shapes: LevelShapes) -> Tensor:
        """As `DeformableAttention.attend`."""
        batch, queries, _ = query.shape
        of_hit = map_queries(1, 1, batch * queries, query.device)
        hits = Hits(of_hit[0], reference_points.reshape(-1, 1, 2), [queries] * batch, of_hit[1])
        sampled = self.sample_hits(self.values(tokens), level_shapes, hits, *self.predict(query.flatten(0, 1)))
        result: Tensor = self.output_projection(sampled.view(batch, queries, -1))
        return result


@cache
def map_queries(batch: int, maps: int, cells: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """`Hits.query` and `Hits.prediction` of maps that all cells sample. They are kept: CUDA graphs hold addresses."""
    query = torch.arange(batch * cells, device=device).view(batch, 1, cells).expand(-1, maps, -1).flatten()
    return query, torch.arange(maps, device=device)[None, :, None].repeat(batch, 1, cells).flatten()


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


class KeptCalibrationEmbedding(LastCall, CalibrationEmbedding):
    """A `CalibrationEmbedding` that computes anew where the cameras have moved."""
