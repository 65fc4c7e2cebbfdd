"""A trained model prepared for inference: the same results, faster.

The plain model knows nothing of this. A prepared model is a copy, some of whose parts are of faster classes with the
same interface.
"""

import atexit
import copy
import threading
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from bevcli.errors import WeightsError
from bevcli.model import Precision
from bevcli.model.decoder import DecoderLayer
from bevcli.model.deformable_attention import FeatureMaps
from bevcli.model.efficientnet_lite import EfficientNetLite
from bevcli.model.encoder import SpatialCrossAttention, TemporalSelfAttention
from bevcli.model.horizon import Ring
from bevcli.model.image_tokens import CalibrationEmbedding, ImageTokens
from bevcli.model.kernels import choose
from bevcli.model.kernels.compiled import CompiledPool, load_compiled
from bevcli.model.kernels.onednn import has_matrix_unit, use_onednn
from bevcli.model.network import Network
from bevcli.model.pillar_projection import Pillars
from bevcli.model.resnet import ResNet
from bevcli.model.temporal_model import TemporalModel

TOKENS_OF_A_BLOCK = 1024  # the sums of a block stay in the cache
LOADING_TIMEOUT_S = 120.0  # the compilation takes half a minute where there is no cache
DTYPES = {"fp32": torch.float32, "bf16": torch.bfloat16, "fp16": torch.float16}


def prepare_for_inference(model: TemporalModel, device: torch.device, precision: Precision = "fp32") -> TemporalModel:
    """A copy of the model on the device, for inference only; the model itself stays unchanged.

    Batch norms are folded into their convolutions, which run in channels-last layout. Deformable attention and
    deformable convolution use the device's fastest kernels, and on a CPU oneDNN runs convolutions and linear layers.
    Results that do not change from frame to frame are computed once (`TemporalModel.fix_constant_parts`, `LastCall`).
    On a CUDA GPU, methods that are marked by `on_device` are replayed as CUDA graphs.

    The precision applies to the path of the images: backbone, neck, image tokens and their values. BEV queries,
    sampling locations, decoder and heads stay in float32: they are a small part of the work, and rounding them would
    move boxes (docs/speed.md has the figures).

    Raises WeightsError where a prepared weight is not finite, as with a batch norm of negative variance.
    """
    network = copy.deepcopy(model).eval().requires_grad_(False)
    network.fix_constant_parts()
    points_on_cpu = {name: module.points for name, module in network.named_modules() if isinstance(module, Pillars)}
    network.to(device)
    choose.fold_batch_norms(network, device)
    choose.choose_kernels(network, device)
    kinds: choose.Kinds = CPU_KINDS
    if device.type != "cpu":
        from bevcli.model.kernels import gpu  # with what only a GPU needs: CUDA graphs, a compiled loop for hits

        kinds = gpu.gpu_kinds(device)
    choose.change_classes(network, kinds)
    if device.type != "cpu":
        gpu.finish_gpu_parts(network, points_on_cpu)
    dtype = DTYPES[precision]
    if isinstance(network, Network):
        network.neck.to(dtype)
        for backbone in (network.backbone, network.image_detector):
            if backbone is not None:
                backbone.to(dtype)
                backbone.register_forward_pre_hook(lambda _, images: (images[0].to(dtype), *images[1:]))
    rounds = precision == "bf16" and device.type == "cpu" and has_matrix_unit()
    if dtype != torch.float32:
        round_attentions(network, dtype, temporal=rounds, queries=rounds or device.type == "cuda")
    for name, parameter in network.named_parameters():  # oneDNN's ReLU would turn NaN into zeros
        if not torch.isfinite(parameter).all():
            raise WeightsError(
                f"{name}: has NaN or infinity after batch norms were folded into it and it was cast to "
                f"{str(parameter.dtype).removeprefix('torch.')}: the weights are damaged, or need `precision=fp32` "
                "(`--precision fp32`)"
            )
    if device.type == "cuda":
        for name in methods_on_device(type(network)):
            network.stages = {"": "model"}  # a graph has no stages
            captured: Any = gpu.Captured(getattr(network, name), network, device, rounds=precision != "fp32")
            setattr(network, name, captured)
    if device.type == "cpu":
        use_onednn(network, rounds=rounds)
        load_loops(network, dtype)
    return network


def round_attentions(network: nn.Module, dtype: torch.dtype, *, temporal: bool, queries: bool) -> None:
    """Gives attentions, in place, parts that compute in the data type of the images.

    Those are the values of the image features, with `temporal` those of the BEV maps, and with `queries` the attention
    of object queries to each other.
    """
    for module in list(network.modules()):
        if isinstance(module, SpatialCrossAttention) or (temporal and isinstance(module, TemporalSelfAttention)):
            projection = module.attention.value_projection
            module.attention.set_submodule("value_projection", RoundedLinear(projection, dtype))
        if queries and isinstance(module, DecoderLayer) and isinstance(module.self_attention, nn.MultiheadAttention):
            module.set_submodule("self_attention", RoundedAttention(module.self_attention, dtype))


def load_loops(network: nn.Module, dtype: torch.dtype) -> None:
    """Loads the compiled loops in a thread, beside the first frame's backbone, which needs no Python.

    Started any earlier, the thread would slow down the copying of the model.
    """
    loaded = threading.Event()
    for module in network.modules():
        if type(module) is ResNet:  # of a subclass, another stem may need negative maxima
            choose.change_classes(module, {nn.MaxPool2d: CompiledPool}, loaded=loaded)
    loading = threading.Thread(target=load_compiled, args=(dtype, loaded), name="load-compiled", daemon=True)
    loading.start()
    atexit.register(loading.join, LOADING_TIMEOUT_S)  # Python cannot end in the middle of a compilation


def methods_on_device(cls: type) -> list[str]:
    """Names of the methods of a class that are marked by `on_device`."""
    return [name for name in dir(cls) if hasattr(getattr(cls, name), "is_on_device")]


class EfficientNetLiteByImage(EfficientNetLite):
    """An `EfficientNetLite` that runs on one image at a time: depthwise convolutions wait for memory."""

    def forward(self, images: Tensor) -> list[Tensor]:
        """As `Backbone.forward`."""
        by_image = [super(EfficientNetLiteByImage, self).forward(image) for image in images.split(1)]
        return [torch.cat(maps) for maps in zip(*by_image, strict=True)]


class RoundedLinear(nn.Module):
    """A linear layer that computes in a half precision, whatever the precision of its input."""

    def __init__(self, linear: nn.Module, dtype: torch.dtype) -> None:
        super().__init__()
        self.linear, self.dtype = linear.to(dtype), dtype

    def forward(self, x: Tensor) -> Tensor:
        """x: (..., in) -> (..., out)."""
        rounded: Tensor = self.linear(x.to(self.dtype))
        return rounded


class RoundedAttention(nn.Module):
    """A multi-head attention that computes in a half precision, for queries, keys and values in float32."""

    def __init__(self, attention: nn.MultiheadAttention, dtype: torch.dtype) -> None:
        super().__init__()
        self.attention, self.dtype = attention.to(dtype), dtype

    def forward(self, query: Tensor, key: Tensor, value: Tensor, *, need_weights: bool) -> tuple[Tensor, None]:
        """As `nn.MultiheadAttention.forward` without weights."""
        rounded = (tensor.to(self.dtype) for tensor in (query, key, value))
        return self.attention(*rounded, need_weights=need_weights)[0].float(), None


class TokensInBlocks(ImageTokens):
    """`ImageTokens` on a CPU: the same sums, block by block, without a copy of all tokens after each."""

    def forward(self, maps: Sequence[Tensor], camera_index: Tensor) -> FeatureMaps:
        """As `ImageTokens.forward`."""
        images, channels = maps[0].shape[:2]
        levels = [x.flatten(2).transpose(1, 2) for x in maps]
        tokens = maps[0].new_empty(images, sum(x.shape[1] for x in levels), channels)
        parts = tokens.split([x.shape[1] for x in levels], dim=1)
        of_cameras = () if self.camera_embedding is None else self.camera_embedding[camera_index].view(-1, channels)
        for level, output, embedding in zip(levels, parts, self.level_embedding, strict=False):
            for image in range(images):
                blocks = (x[image].split(TOKENS_OF_A_BLOCK) for x in (level, output))
                for block, result in zip(*blocks, strict=True):
                    block = block + embedding
                    if len(of_cameras):
                        block += of_cameras[image % len(of_cameras)]
                    result.copy_(block)
        return FeatureMaps(tokens, tuple((x.shape[-2], x.shape[-1]) for x in maps))


# The classes that take the place of plain ones on a CPU, beside those of `choose_kernels`.
CPU_KINDS: choose.Kinds = {
    Pillars: choose.KeptPillars,
    Ring: choose.KeptRing,
    CalibrationEmbedding: choose.KeptCalibrationEmbedding,
    EfficientNetLite: EfficientNetLiteByImage,
    ImageTokens: TokensInBlocks,
}
