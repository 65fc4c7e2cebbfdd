"""The Triton kernel after convolutions, without a GPU: it compiles for all cards, and interpreted it equals PyTorch."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

triton = pytest.importorskip("triton", reason="Triton is not installed: make test-all installs it, on Linux")

INTERPRETED = """
import contextlib, copy, torch
torch.cuda.device = lambda which: contextlib.nullcontext()
from bevcli.model.kernels.choose import fold_batch_norms
from bevcli.model.kernels.triton_bottleneck import FusedBottleneck
from bevcli.model.prepare import add_to_class
from bevcli.model.resnet import Bottleneck
torch.manual_seed(0)
for stride, channels, size in ((1, 32, (12, 20)), (2, 24, (12, 20)), (1, 24, (1, 1))):
    plain = Bottleneck(channels, 8, stride, "pytorch", False).eval().requires_grad_(False)
    for norm in (plain.bn1, plain.bn2, plain.bn3):
        norm.weight.fill_(0.7), norm.bias.normal_(), norm.running_mean.normal_()
    fused = copy.deepcopy(plain)
    fold_batch_norms(fused, torch.device("meta"))
    add_to_class(fused.to(memory_format=torch.channels_last), FusedBottleneck)
    x = torch.randn(2, channels, *size)
    for images in (x, x.to(memory_format=torch.channels_last), x[:0]):
        torch.testing.assert_close(fused(images), plain(images), rtol=1e-5, atol=1e-5)
    x[0, 0, 0, 0] = torch.nan
    assert fused(x.to(memory_format=torch.channels_last)).isnan().any()
print("equal")
"""


@pytest.mark.parametrize("generation", [75, 80, 86, 89, 90, 100])
@pytest.mark.parametrize("dtype", ["fp32", "bf16", "fp16"])
def test_the_kernel_compiles_for_every_generation(generation, dtype, tmp_path, monkeypatch):
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    from bevcli.model.kernels.triton_bottleneck import ELEMENTS_PER_PROGRAM, _add_and_relu

    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path))
    constants = {"HAS_SHORTCUT": True, "BLOCK": ELEMENTS_PER_PROGRAM}
    types = {"values": f"*{dtype}", "bias": f"*{dtype}", "shortcut": f"*{dtype}", "elements": "i32", "channels": "i32"}
    source = ASTSource(_add_and_relu, {**types, **dict.fromkeys(constants, "constexpr")}, constexprs=constants)
    assert triton.compile(source, target=GPUTarget("cuda", generation, 32)).asm["cubin"].startswith(b"\x7fELF")


def test_fused_bottlenecks_equal_plain_ones_when_interpreted():
    environment = {**os.environ, "TRITON_INTERPRET": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", INTERPRETED]
    answer = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert answer.stdout.strip() == "equal", answer.stderr
