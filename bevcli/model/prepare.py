"""A trained model prepared for inference: the same results, faster.

The plain model knows nothing of this. A prepared model holds a copy whose parts are exchanged for faster ones.
"""

import atexit
import copy
import threading
from collections.abc import Sequence
from typing import Any, Literal

import torch
from torch import Tensor, nn

from bevcli.errors import WeightsError
from bevcli.frame import BevMap, FrameResult
from bevcli.geometry.boxes import Boxes3D
from bevcli.model.calibration_embedding import CalibrationEmbedding, modulated
from bevcli.model.decoder import DecoderLayer
from bevcli.model.deformable_attention import FeatureMaps, LevelShapes
from bevcli.model.encoder import SpatialCrossAttention, TemporalSelfAttention
from bevcli.model.kernels.choose import choose_kernels, fold_batch_norms
from bevcli.model.kernels.compiled import CompiledPool, load_compiled, sample_hits
from bevcli.model.kernels.onednn import has_matrix_unit, use_onednn
from bevcli.model.pillar_projection import PillarHits, Pillars
from bevcli.model.resnet import ResNet
from bevcli.model.step import ModelOutputs, PreparedFrame
from bevcli.model.temporal_model import Memory, TemporalModel

Precision = Literal["fp32", "bf16", "fp16"]
LOADING_TIMEOUT_S = 120.0  # the compilation takes half a minute where there is no cache
DTYPES = {"fp32": torch.float32, "bf16": torch.bfloat16, "fp16": torch.float16}


def prepare_for_inference(model: TemporalModel, device: torch.device, precision: Precision = "fp32") -> "PreparedModel":
    """A copy of the model on the device, for inference only; the model itself stays unchanged.

    Batch norms are folded into their convolutions, which run in channels-last layout. Deformable attention and
    deformable convolution use the device's fastest kernels, and on a CPU oneDNN runs convolutions and linear layers.
    Results that do not change from frame to frame are computed once (`TemporalModel.exchange_parts`, `CachedPillars`,
    `CachedCalibrationEmbedding`).

    The precision applies to the path of the images: backbone, neck, image tokens and their values. BEV queries,
    sampling locations, decoder and heads stay in float32: they are a small part of the work, and rounding them would
    move boxes (docs/speed.md has the figures).

    Raises WeightsError where a prepared weight is not finite, as with a batch norm of negative variance.
    """
    network = copy.deepcopy(model).eval().requires_grad_(False)
    network.exchange_parts()
    network.to(device)
    fold_batch_norms(network, device)
    choose_kernels(network, device)
    for part in network.image_parts:
        part.to(DTYPES[precision])
    rounds = precision == "bf16" and device.type == "cpu" and has_matrix_unit()
    rounded = (SpatialCrossAttention, TemporalSelfAttention) if rounds else (SpatialCrossAttention,)
    for name, module in list(network.named_modules()):
        if type(module) is Pillars:
            network.set_submodule(name, CachedPillars(network.config.bev_grid).to(device))
        if isinstance(module, CalibrationEmbedding):
            network.set_submodule(name, CachedCalibrationEmbedding(module))
        if rounds and isinstance(module, DecoderLayer) and isinstance(module.self_attention, nn.MultiheadAttention):
            network.set_submodule(f"{name}.self_attention", RoundedAttention(module.self_attention))
        if isinstance(module, rounded):
            module.attention.value_projection.to(DTYPES[precision])
            module.attention.value_dtype = DTYPES[precision]
        if isinstance(module, SpatialCrossAttention) and device.type == "cpu":
            module.sample_hits = sample_hits
    _check_finite(network)
    if device.type == "cpu":
        use_onednn(network, rounds=rounds)
        loaded = threading.Event()
        for name, module in list(network.named_modules()):
            if isinstance(module, ResNet):
                network.set_submodule(f"{name}.pool", CompiledPool(module.pool, loaded))
        # Runs beside the first frame's backbone, which needs no Python. Started any earlier, it would slow down the
        # copying of the model.
        arguments = DTYPES[precision], loaded
        loading = threading.Thread(target=load_compiled, args=arguments, name="load-compiled", daemon=True)
        loading.start()
        atexit.register(loading.join, LOADING_TIMEOUT_S)  # Python cannot end in the middle of a compilation
    return PreparedModel(network, precision)


class PreparedModel(TemporalModel):
    """A model that `prepare_for_inference` made, with its exchanged parts. Autocast around it has no effect."""

    def __init__(self, network: TemporalModel, precision: Precision) -> None:
        super().__init__(network.config)
        self.network = network
        self.stages, self.has_parts = network.stages, network.has_parts
        if network.image_parts:
            dtype = DTYPES[precision]
            network.image_parts[0].register_forward_pre_hook(lambda _, images: (images[0].to(dtype), *images[1:]))

    def forward(self, *inputs: Any) -> ModelOutputs:
        """As the model's own `forward`."""
        with torch.autocast(self.device.type, enabled=False):
            outputs: ModelOutputs = self.network(*inputs)
        return outputs

    def step(
        self, prepared: PreparedFrame, memory: Memory | None, upcoming: Sequence[PreparedFrame] = ()
    ) -> tuple[ModelOutputs, Memory]:
        with torch.autocast(self.device.type, enabled=False):
            return self.network.step(prepared, memory, upcoming)

    def restarted(self, memory: Memory) -> Memory | None:
        return self.network.restarted(memory)

    def decode_boxes(self, outputs: ModelOutputs) -> Boxes3D:
        return self.network.decode_boxes(outputs)

    def decode_map(self, outputs: ModelOutputs) -> BevMap | None:
        return self.network.decode_map(outputs)

    def decode_results(self, outputs: ModelOutputs) -> tuple[FrameResult, ...]:
        return self.network.decode_results(outputs)

    @property
    def observed(self) -> nn.Module:
        return self.network


def _check_finite(model: nn.Module) -> None:
    """Raises WeightsError for a folded or cast weight with NaN or infinity: oneDNN's ReLU would turn it into zeros."""
    for name, parameter in model.named_parameters():
        if not torch.isfinite(parameter).all():
            raise WeightsError(
                f"{name}: has NaN or infinity after batch norms were folded into it and it was cast to "
                f"{str(parameter.dtype).removeprefix('torch.')}: the weights are damaged, or need `precision=fp32`"
            )


class RoundedAttention(nn.Module):
    """A multi-head attention that computes in bfloat16, for queries, keys and values in float32."""

    def __init__(self, attention: nn.MultiheadAttention) -> None:
        super().__init__()
        self.attention = attention.to(torch.bfloat16)

    def forward(self, query: Tensor, key: Tensor, value: Tensor, *, need_weights: bool) -> tuple[Tensor, None]:
        """As `nn.MultiheadAttention.forward` without weights."""
        rounded = (tensor.to(torch.bfloat16) for tensor in (query, key, value))
        return self.attention(*rounded, need_weights=need_weights)[0].float(), None


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


class CachedCalibrationEmbedding(nn.Module):
    """Computes the embedding again only when the projections or the images' sizes are not those of the last call."""

    _inputs: tuple[Tensor, LevelShapes, tuple[int, int]] | None = None
    _factor_and_shift: tuple[Tensor, Tensor]

    def __init__(self, embedding: CalibrationEmbedding) -> None:
        super().__init__()
        self.embedding = embedding

    def forward(self, image_features: FeatureMaps, image_from_bev: Tensor, image_size: tuple[int, int]) -> FeatureMaps:
        """As `CalibrationEmbedding.forward`."""
        sizes = image_features.level_shapes, image_size
        if self._inputs is None or self._inputs[1:] != sizes or not _equal(image_from_bev, self._inputs[0]):
            self._factor_and_shift = self.embedding.factor_and_shift(image_from_bev, *sizes)
            self._inputs = image_from_bev.clone(), *sizes
        return modulated(image_features, *self._factor_and_shift)


def _equal(one: Tensor, other: Tensor) -> bool:
    return one.shape == other.shape and one.device == other.device and torch.equal(one, other)
