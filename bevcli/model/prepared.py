"""A trained model prepared for inference: the same results, faster.

The plain model knows nothing of this. A prepared model is a copy whose parts are replaced by faster ones.
"""

from __future__ import annotations

import atexit
import copy
import threading
from collections.abc import Sequence
from dataclasses import replace
from importlib.util import find_spec
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_weights

from bevcli.errors import WeightsError
from bevcli.model.bev_fusion import FusionBlock
from bevcli.model.bevformer import BEVFormer, BEVFormerBase, BEVFormerInputs, BEVFormerOutputs
from bevcli.model.bevformer_v2 import BEVFormerV2, WindowFrame
from bevcli.model.decoder import Decoder, DecoderLayer
from bevcli.model.deformable_attention import DeformableAttention, FeatureMaps, GridSampling
from bevcli.model.deformable_convolution import ModulatedDeformableConvolution
from bevcli.model.encoder import EncoderLayer, SpatialCrossAttention, TemporalSelfAttention
from bevcli.model.kernels.compiled import CompiledDeformableConvolution, CompiledSampling, load_compiled
from bevcli.model.kernels.onednn import use_onednn
from bevcli.model.kernels.tables import Tables
from bevcli.model.pillar_projection import PillarHits, Pillars
from bevcli.model.resnet import Bottleneck, ResNet
from bevcli.model.track_queries import FrameMotion, TrackQueries
from bevcli.model.uniad import UniAD, UniADOutputs

Precision = Literal["fp32", "bf16", "fp16"]
LOADING_TIMEOUT_S = 120.0  # the compilation takes half a minute where there is no cache
DTYPES = {"fp32": torch.float32, "bf16": torch.bfloat16, "fp16": torch.float16}


def prepare_for_inference(
    model: BEVFormerBase, device: torch.device, precision: Precision = "fp32"
) -> PreparedBEVFormer | PreparedBEVFormerV2 | PreparedUniAD:
    """A copy of the model on the device, for inference only; the model itself stays unchanged.

    Raises WeightsError where a prepared weight is not finite, as with a batch norm of negative variance.
    """
    prepared: PreparedBEVFormer | PreparedBEVFormerV2 | PreparedUniAD
    if isinstance(model, BEVFormerV2):
        prepared = PreparedBEVFormerV2(model, device, precision)
    elif isinstance(model, UniAD):
        prepared = PreparedUniAD(model, device, precision)
    else:
        assert isinstance(model, BEVFormer)
        prepared = PreparedBEVFormer(model, device, precision)
    if device.type == "cpu":
        # Runs beside the first frame's backbone, which needs no Python. Started any earlier, it would slow down the
        # copying of the model.
        loading = threading.Thread(target=load_compiled, args=(DTYPES[precision],), name="load-compiled", daemon=True)
        loading.start()
        atexit.register(loading.join, LOADING_TIMEOUT_S)  # Python cannot end in the middle of a compilation
    return prepared


class PreparedBEVFormer(BEVFormer):
    """A BEVFormer for inference on one device.

    Batch norms are folded into their convolutions, which run in channels-last layout. Deformable attention and
    deformable convolution use the device's fastest kernels, and on a CPU oneDNN runs convolutions and linear layers.
    Results that do not change from frame to frame are computed once (`ConstantSelfAttention`, `CachedPillars`).

    The precision applies to the path of the images: backbone, neck, image tokens and their values. BEV queries,
    sampling locations, decoder and heads stay in float32: they are a small part of the work, and rounding them would
    move boxes (docs/speed.md has the figures). Autocast around a prepared model has no effect.
    """

    def __init__(self, model: BEVFormer, device: torch.device, precision: Precision) -> None:
        nn.Module.__init__(self)  # not BEVFormer's, which would make new weights
        self.__dict__.update(copy.deepcopy(model).__dict__)
        self.images_dtype = DTYPES[precision]
        _prepare(self, device, self.images_dtype)

    def forward(self, inputs: BEVFormerInputs, history: Tensor | None = None) -> BEVFormerOutputs:
        """As `BEVFormer.forward`."""
        with torch.autocast(inputs.images.device.type, enabled=False):
            return super().forward(replace(inputs, images=inputs.images.to(self.images_dtype)), history)


class PreparedBEVFormerV2(BEVFormerV2):
    """A BEVFormerV2 for inference on one device: see `PreparedBEVFormer`.

    The first temporal self-attention of the encoder is constant too, because no ego-motion enters the BEV queries.
    In the others the queries take the place of the history.
    """

    def __init__(self, model: BEVFormerV2, device: torch.device, precision: Precision) -> None:
        nn.Module.__init__(self)
        self.__dict__.update(copy.deepcopy(model).__dict__)
        self.images_dtype = DTYPES[precision]
        self.eval().requires_grad_(False)
        self.encoder.layers[0].temporal_self_attention = ConstantTemporalSelfAttention(self)
        for layer in self.encoder.layers[1:]:
            assert isinstance(layer, EncoderLayer)
            attention = OwnQueriesAttention(layer.temporal_self_attention, self.bev_queries.position())
            layer.temporal_self_attention = attention
        _prepare(self, device, self.images_dtype)

    def image_features(self, images: Tensor, camera_index: Tensor) -> FeatureMaps:
        """As `BEVFormerV2.image_features`."""
        with torch.autocast(images.device.type, enabled=False):
            return super().image_features(images.to(self.images_dtype), camera_index)

    def forward(self, window: Sequence[WindowFrame | None]) -> BEVFormerOutputs:
        """As `BEVFormerV2.forward`."""
        with torch.autocast(self.encoder.cell_centers.device.type, enabled=False):
            return super().forward(window)


class PreparedUniAD(UniAD):
    """A UniAD for inference on one device: see `PreparedBEVFormer`."""

    def __init__(self, model: UniAD, device: torch.device, precision: Precision) -> None:
        nn.Module.__init__(self)
        self.__dict__.update(copy.deepcopy(model).__dict__)
        self.images_dtype = DTYPES[precision]
        _prepare(self, device, self.images_dtype)

    def forward(
        self,
        inputs: BEVFormerInputs,
        history: Tensor | None = None,
        tracks: TrackQueries | None = None,
        motion: FrameMotion | None = None,
    ) -> UniADOutputs:
        """As `UniAD.forward`."""
        with torch.autocast(inputs.images.device.type, enabled=False):
            return super().forward(replace(inputs, images=inputs.images.to(self.images_dtype)), history, tracks, motion)


def _prepare(model: BEVFormerBase, device: torch.device, images_dtype: torch.dtype) -> None:
    """Replaces the parts of a model by faster ones, in place."""
    model.to(device).eval().requires_grad_(False)
    fold_batch_norms(model, device)
    choose_kernels(model, device)
    model.pillars = CachedPillars(model.config.bev_grid).to(device)
    if not isinstance(model, UniAD):  # whose tracks attend to the learned queries
        model.decoder.layers[0].self_attention = ConstantSelfAttention(model.decoder)
    for part in (model.backbone, model.neck):
        part.to(images_dtype)
    tables = Tables()
    for module in model.modules():
        if isinstance(module, SpatialCrossAttention):
            module.attention.value_projection.to(images_dtype)
        if isinstance(module, DeformableAttention):
            module.level_sizes = tables.level_sizes
    _check_finite(model)
    if device.type == "cpu":
        use_onednn(model)


def _check_finite(model: nn.Module) -> None:
    """Raises WeightsError for a folded or cast weight with NaN or infinity: oneDNN's ReLU would turn it into zeros."""
    for name, parameter in model.named_parameters():
        if not torch.isfinite(parameter).all():
            raise WeightsError(
                f"{name}: has NaN or infinity after batch norms were folded into it and it was cast to "
                f"{str(parameter.dtype).removeprefix('torch.')}: the weights are damaged, or need --precision fp32"
            )


class CachedPillars(Pillars):
    """Projects the pillars again only when calibration, poses or images are not those of the last call.

    The comparison needs no wait for a GPU where `image_from_bev` and `has_image` are on the CPU.
    """

    _inputs: tuple[Tensor, Tensor, tuple[int, int]] | None = None
    _hits: PillarHits

    def forward(self, image_from_bev: Tensor, image_size: tuple[int, int], has_image: Tensor) -> PillarHits:
        """As `Pillars.forward`."""
        if self._inputs is None or not (
            image_size == self._inputs[2]
            and _equal(image_from_bev, self._inputs[0])
            and _equal(has_image, self._inputs[1])
        ):
            self._inputs = image_from_bev.clone(), has_image.clone(), image_size
            self._hits = super().forward(image_from_bev, image_size, has_image)
        return self._hits


class ConstantSelfAttention(nn.Module):
    """Takes the place of the self-attention in the first decoder layer, whose input is the same in every frame."""

    attended: Tensor

    def __init__(self, decoder: Decoder) -> None:
        super().__init__()
        first = decoder.layers[0]
        assert isinstance(first, DecoderLayer)
        with torch.no_grad():
            queries = decoder.object_queries(batch=1)
            key = queries.content + queries.position
            attended, _ = first.self_attention(key, key, queries.content, need_weights=False)
        self.register_buffer("attended", attended, persistent=False)  # (1, Q, C)

    def forward(self, query: Tensor, key: Tensor, value: Tensor, *, need_weights: bool) -> tuple[Tensor, None]:
        """query, key, value: (B, Q, C), of which only B is read -> (B, Q, C), None."""
        return self.attended.expand_as(value), None


class ConstantTemporalSelfAttention(nn.Module):
    """Takes the place of the first encoder layer's temporal self-attention, whose input is the same in every frame."""

    attended: Tensor

    def __init__(self, model: BEVFormerV2) -> None:
        super().__init__()
        layer = model.encoder.layers[0]
        assert isinstance(layer, EncoderLayer)
        self.attention = layer.temporal_self_attention.attention  # for observers of the encoder
        queries = model.bev_queries.embedding[None]
        maps, reference_points = queries[:, None], model.encoder.reference_points(None)
        with torch.no_grad():
            attended = layer.temporal_self_attention(queries, model.bev_queries.position(), maps, reference_points)
        self.register_buffer("attended", attended, persistent=False)  # (1, Y·X, C)

    def forward(self, query: Tensor, position: Tensor, bev_maps: Tensor, reference_points: Tensor) -> Tensor:
        """Arguments as for `TemporalSelfAttention`, of which only the shape of the query is read -> (B, Y·X, C)."""
        return self.attended.expand_as(query)


class OwnQueriesAttention(TemporalSelfAttention):
    """A temporal self-attention that never has a history: both maps are the queries.

    Offsets and weights are a linear function of (query, query + position). The products with the query are added up
    beforehand, and those with the position computed.
    """

    constant: Tensor

    def __init__(self, attention: TemporalSelfAttention, position: Tensor) -> None:
        """position: (Y·X, C), position embedding of the cells."""
        nn.Module.__init__(self)
        self.__dict__.update(copy.copy(attention).__dict__)
        layers = (attention.attention.sampling_offsets, attention.attention.attention_weights)
        of_history, of_query = torch.cat([layer.weight for layer in layers]).chunk(2, dim=1)
        bias = torch.cat([layer.bias for layer in layers])
        self.sizes = [layer.out_features for layer in layers]
        self.both = nn.Linear(of_query.shape[1], of_query.shape[0], bias=False, device="meta")
        self.both.weight = nn.Parameter(of_history + of_query, requires_grad=False)
        self.register_buffer("constant", position @ of_query.T + bias, persistent=False)  # (Y·X, both sizes)

    def predict(self, query: Tensor, position: Tensor, history: Tensor) -> tuple[Tensor, Tensor]:
        """As `TemporalSelfAttention.predict`; reads the query only."""
        return self.attention.as_samples(*(self.both(query) + self.constant).split(self.sizes, dim=-1))


class BiasedDeformableConvolution(nn.Module):
    """A deformable convolution with the bias that is left of a batch norm folded into it."""

    def __init__(self, convolution: ModulatedDeformableConvolution, bias: Tensor) -> None:
        super().__init__()
        self.convolution = convolution
        self.bias = nn.Parameter(bias.detach(), requires_grad=False)

    def forward(self, x: Tensor) -> Tensor:
        """x: (B, C, H, W) -> (B, O, H', W')."""
        return self.convolution(x) + self.bias[:, None, None]


def choose_kernels(model: BEVFormerBase, device: torch.device, *, gradients: bool = False) -> None:
    """Gives a model, in place, the memory layout and the deformable attention that are fastest on a device.

    gradients: whether the model is trained; then only kernels with gradients are used.
    """
    fusion = getattr(model, "fusion", None)
    for part in (model.backbone, model.neck, *([] if fusion is None else [fusion])):
        part.to(memory_format=torch.channels_last)
    tables = Tables()
    for module in model.modules():
        if isinstance(module, DeformableAttention):
            module.sampling = fastest_sampling(device, tables, gradients=gradients)


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


def fold_batch_norms(model: nn.Module, device: torch.device) -> None:
    """Folds every batch norm into the convolution before it, in place, for inference on a device."""
    for block in model.modules():
        if isinstance(block, ResNet):
            _fold(block, "conv1", "bn1", device)
        if isinstance(block, Bottleneck | FusionBlock):
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


def _equal(one: Tensor, other: Tensor) -> bool:
    return one.shape == other.shape and one.device == other.device and torch.equal(one, other)
