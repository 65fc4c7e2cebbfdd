"""The Triton kernel of deformable attention, without a GPU: it compiles for every generation of cards, and in Triton's
interpreter it equals the plain module."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from bevcli.config import known_models, load_config
from bevcli.model.config import ModelConfig

pytest.importorskip("triton", reason="Triton is not installed: make test-all installs it, on Linux")

# Turing, A100, RTX 30, RTX 40, H100, B200.
GENERATIONS = (75, 80, 86, 89, 90, 100)
WARP = 32  # threads


def shapes(config: ModelConfig) -> set[tuple[int, int, int, int, bool]]:
    """(heads, channels of a head, levels, points, whether the values are image features) of a model's attentions."""
    encoder, decoder, segmentation = config.encoder, config.decoder, config.segmentation
    found = {
        (encoder.attention_heads, 1, encoder.temporal_points, False),
        (encoder.attention_heads, config.encoder_levels, encoder.spatial_points, True),
        (decoder.attention_heads, 1, decoder.points, False),
    }
    if "segmentation" in config.heads:
        found.add((segmentation.attention_heads, 1, segmentation.points, False))
    return {(heads, config.channels // heads, levels, points, images) for heads, levels, points, images in found}


KERNELS = sorted(
    (*kernel[:4], dtype)
    for kernel in set().union(*(shapes(load_config(name)) for name in known_models()))
    for dtype in (("fp32", "bf16", "fp16") if kernel[4] else ("fp32",))
)


def compile_kernel(generation: int, heads: int, depth: int, levels: int, points: int, dtype: str) -> bytes:
    """The machine code for a generation of cards."""
    import triton
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    from bevcli.model.kernels.triton_attention import _sample, constants

    constexprs = constants(heads, depth, levels, points)
    types = {"values": f"*{dtype}", "shapes": "*i32", "locations": "*fp32", "weights": "*fp32", "ends": "*i32"}
    types |= {"out": "*fp32", "queries": "i32", "maps": "i32", "cells": "i32"}
    source = ASTSource(_sample, {**types, **dict.fromkeys(constexprs, "constexpr")}, constexprs=constexprs)
    return triton.compile(source, target=GPUTarget("cuda", generation, WARP)).asm["cubin"]


@pytest.fixture(autouse=True)
def no_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path))


@pytest.mark.parametrize("generation", [GENERATIONS[0], GENERATIONS[-1]])
def test_the_kernel_compiles_for_the_oldest_and_the_newest_cards(generation):
    assert compile_kernel(generation, *max(KERNELS)).startswith(b"\x7fELF")


@pytest.mark.slow
@pytest.mark.parametrize("generation", GENERATIONS)
@pytest.mark.parametrize("kernel", KERNELS, ids=str)
def test_the_kernel_compiles_for_the_shapes_of_every_model(generation, kernel):
    assert compile_kernel(generation, *kernel).startswith(b"\x7fELF")


INTERPRETED = """
import contextlib
import torch
torch.cuda.device = lambda which: contextlib.nullcontext()
from bevcli.model.deformable_attention import GridSampling
from bevcli.model.kernels.triton_attention import TritonSampling
from test_deformable_attention_backends import case
for depth, counts, dtype in ((6, (0, 3, 0, 2), torch.float32), (8, (4,), torch.float16)):
    inputs = case(depth, counts, dtype)
    torch.testing.assert_close(TritonSampling()(*inputs), GridSampling()(*inputs), rtol=1e-4, atol=1e-4)
assert TritonSampling()(*case(4, (0, 0))).shape == (0, 12)
print("equal")
"""


@pytest.mark.slow
def test_the_kernel_equals_the_plain_module_when_interpreted(request):
    folder = str(request.path.parent)
    environment = {**os.environ, "TRITON_INTERPRET": "1", "PYTHONPATH": os.pathsep.join([*sys.path, folder])}
    command = [sys.executable, "-c", INTERPRETED]
    answer = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert answer.stdout.strip() == "equal", answer.stderr
