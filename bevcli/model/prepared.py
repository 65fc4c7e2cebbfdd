"""A trained model made ready to be run: the same answers, sooner."""

from __future__ import annotations

import copy
import threading
from typing import Literal

import torch
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_weights

from bevcli.model.bevformer import BEVFormer
from bevcli.model.deformable_attention import DeformableAttention, fastest_backend
from bevcli.model.deformable_convolution import ModulatedDeformableConvolution
from bevcli.model.kernels.compiled_attention import load_compiled
from bevcli.model.kernels.onednn import use_onednn
from bevcli.model.resnet import Bottleneck, ResNet
from bevcli.model.spatial_cross_attention import SpatialCrossAttention

Precision = Literal["fp32", "bf16", "fp16"]
DTYPES = {"fp32": torch.float32, "bf16": torch.bfloat16, "fp16": torch.float16}


def prepare_for_inference(model: BEVFormer, device: torch.device, precision: Precision = "fp32") -> BEVFormer:
    """A copy of the model on the device, for inference only; the model itself stays as it is.

    What is the same in every frame is worked out here, what hangs on calibration and poses when these change.
    Batch norms are folded into their convolutions, images are convolved channels-last, deformable operations take
    the device's fastest backends, and on a CPU oneDNN runs convolutions and linear layers. At half precision the
    whole way of the images computes in it: backbone, neck, image tokens and their values. What follows moves boxes
    by decimetres when it is rounded, and is a small part of the work: BEV queries, sampling locations, decoder and
    heads stay in float32.
    """
    prepared = copy.deepcopy(model).to(device).eval().requires_grad_(False)
    prepared.prepared = True
    _fold_batch_norms(prepared.backbone)
    choose_kernels(prepared, device)
    with torch.no_grad():
        prepared.bev_queries.kept_position = prepared.bev_queries.position()
        prepared.decoder.kept_first_queries = prepared.decoder.first_queries()
    _lower_precision(prepared, DTYPES[precision])
    if device.type == "cpu":
        use_onednn(prepared)
        # Beside the first frame's backbone, which needs no Python: the start is half a second sooner. Not before,
        # because copying the model would wait for it at every tensor.
        threading.Thread(target=load_compiled, args=(DTYPES[precision],), name="load-compiled").start()
    return prepared


def choose_kernels(model: BEVFormer, device: torch.device, *, gradients: bool = False) -> None:
    """Gives a model, in place, the layouts and backends that compute the same soonest on a device.

    gradients: whether they are asked for.
    """
    for part in (model.backbone, model.neck):
        part.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    for module in model.modules():
        if isinstance(module, DeformableAttention):
            module.backend = fastest_backend(device, gradients=gradients)
        elif isinstance(module, ModulatedDeformableConvolution) and device.type == "cpu" and not gradients:
            module.backend = "compiled"


def textbook_version(model: BEVFormer, device: torch.device) -> BEVFormer:
    """A copy of the model that computes as the textbooks say: the yardstick and the oracle of the prepared one.

    Batch norms apart, channels-first float32, `grid_sample` with all queries padded to the longest camera.
    """
    textbook = copy.deepcopy(model).to(device).eval().requires_grad_(False)
    for module in textbook.modules():
        if isinstance(module, DeformableAttention):
            module.backend = "padded"
    return textbook


def _fold_batch_norms(backbone: ResNet) -> None:
    _fold(backbone, "conv1", "bn1")
    for block in backbone.modules():
        if isinstance(block, Bottleneck):
            for number in (1, 2, 3):
                _fold(block, f"conv{number}", f"bn{number}")
            if isinstance(block.downsample, nn.Sequential):
                _fold(block.downsample, "0", "1")


def _fold(parent: nn.Module, convolution_name: str, norm_name: str) -> None:
    """Folds a batch norm into the convolution before it; an identity takes its place."""
    convolution, norm = parent.get_submodule(convolution_name), parent.get_submodule(norm_name)
    assert isinstance(convolution, nn.Conv2d | ModulatedDeformableConvolution)
    assert isinstance(norm, nn.BatchNorm2d)
    assert norm.running_mean is not None
    assert norm.running_var is not None
    convolution.weight, convolution.bias = fuse_conv_bn_weights(
        convolution.weight, convolution.bias, norm.running_mean, norm.running_var, norm.eps, norm.weight, norm.bias
    )
    parent.set_submodule(norm_name, nn.Identity())


def _lower_precision(model: BEVFormer, dtype: torch.dtype) -> None:
    for part in (model.backbone, model.neck):
        part.to(dtype)
    for module in model.encoder.modules():
        if isinstance(module, SpatialCrossAttention):
            module.attention.value_projection.to(dtype)
