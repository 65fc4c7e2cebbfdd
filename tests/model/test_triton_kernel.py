"""The Triton kernels, without a GPU: they compile for every generation of cards, and in Triton's interpreter they equal
the plain versions."""

import os
import subprocess
import sys
from itertools import product
from typing import Any

import pytest
from interpreted_kernels import AttentionShape, attention_shapes, convolution_shapes

from bevcli.config import known_models, load_config

pytest.importorskip("triton", reason="Triton is not installed: make test-all installs it, on Linux")

# Turing, A100, RTX 30, RTX 40, H100, B200.
GENERATIONS = (75, 80, 86, 89, 90, 100)
WARP = 32  # threads
CONFIGS = [load_config(name) for name in known_models()]
DTYPES = ("fp32", "bf16", "fp16")
ATTENTIONS = sorted(product(set().union(*map(attention_shapes, CONFIGS)), DTYPES))
CONVOLUTIONS = sorted(
    (*shape, dtype) for shape, dtype in product(set().union(*map(convolution_shapes, CONFIGS)), DTYPES)
)


def compile_kernel(kernel: Any, generation: int, types: dict[str, str], constants: dict[str, int]) -> bytes:
    """The machine code for a generation of cards. types: of the tensors; numbers are int32."""
    import triton
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    options = {name: constants[name] for name in ("num_warps", "num_stages") if name in constants}
    constexprs = {name: value for name, value in constants.items() if name not in options}
    signature = {
        name: f"*{types[name]}" if name in types else "constexpr" if name in constexprs else "i32"
        for name in kernel.arg_names
    }
    # As on a GPU, where the memory of tensors is aligned.
    attributes = {(i,): [["tt.divisibility", 16]] for i, name in enumerate(kernel.arg_names) if name in types}
    source = ASTSource(kernel, signature, constexprs=constexprs, attrs=attributes)
    return triton.compile(source, target=GPUTarget("cuda", generation, WARP), options=options).asm["cubin"]


def compile_attention(generation: int, shape: AttentionShape, dtype: str) -> list[bytes]:
    """The machine codes of the results, of those of hits, and of the gradients."""
    from bevcli.model.kernels.triton_attention import _sample, _sample_backward, _sample_hits, constants

    types = dict.fromkeys(("locations", "weights", "out", "out_gradient"), "fp32")
    types |= dict.fromkeys(("values_gradient", "locations_gradient", "weights_gradient"), "fp32")
    types |= {"values": dtype, "shapes": "i32", "ends": "i32"}
    chosen = constants(*shape[:4])
    codes = [compile_kernel(kernel, generation, types, chosen) for kernel in (_sample, _sample_backward)]
    types |= dict.fromkeys(("reference_points", "offsets", "logits"), "fp32")
    types |= dict.fromkeys(("query_of_hit", "prediction_of_hit"), "i64")
    samples = 1 << (shape.levels * shape.points - 1).bit_length()
    chosen |= {"PREDICTIONS": shape.maps, "PILLAR_POINTS": shape.pillar_points, "SAMPLES": samples}
    return [*codes, compile_kernel(_sample_hits, generation, types, chosen)]


def compile_stem(generation: int, dtype: str) -> list[bytes]:
    """The machine code of the pooling of a ResNet's stem."""
    from bevcli.model.kernels.triton_convolution import ELEMENTS_PER_PROGRAM, _pool

    types = dict.fromkeys(("values", "bias", "out"), dtype)
    return [compile_kernel(_pool, generation, types, {"CHANNELS": 64, "BLOCK": ELEMENTS_PER_PROGRAM})]


def compile_convolution(generation: int, channels: int, stride: int, dtype: str) -> list[bytes]:
    """The machine codes of the columns and of the gradients."""
    import bevcli.model.kernels.triton_convolution as convolution

    types = dict.fromkeys(("values", "predicted", "columns", "columns_gradient"), dtype)
    types |= dict.fromkeys(("values_gradient", "predicted_gradient"), "fp32")
    kernels = {
        convolution._write_columns: convolution.COLUMN_TILES,
        convolution._add_gradients: convolution.GRADIENT_TILES,
    }
    return [
        compile_kernel(kernel, generation, types, convolution.constants(channels, stride, tiles))
        for kernel, tiles in kernels.items()
    ]


@pytest.fixture(autouse=True)
def no_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path))


@pytest.mark.parametrize("generation", [GENERATIONS[0], GENERATIONS[-1]])
def test_the_kernels_compile_for_the_oldest_and_newest_cards(generation):
    codes = compile_attention(generation, *max(ATTENTIONS)) + compile_convolution(generation, *max(CONVOLUTIONS))
    codes += compile_stem(generation, "fp16")
    assert all(code.startswith(b"\x7fELF") for code in codes)


@pytest.mark.slow
@pytest.mark.parametrize("generation", GENERATIONS)
@pytest.mark.parametrize("kernel", ATTENTIONS, ids=str)
def test_attention_compiles_for_the_shapes_of_every_model(generation, kernel):
    assert all(code.startswith(b"\x7fELF") for code in compile_attention(generation, *kernel))


@pytest.mark.slow
@pytest.mark.parametrize("generation", GENERATIONS)
@pytest.mark.parametrize("kernel", CONVOLUTIONS, ids=str)
def test_convolution_compiles_for_the_shapes_of_every_model(generation, kernel):
    if kernel[-1] == "bf16" and generation < 80:
        pytest.skip("these cards have no bfloat16")
    assert all(code.startswith(b"\x7fELF") for code in compile_convolution(generation, *kernel))


@pytest.mark.slow
def test_the_kernels_equal_the_plain_versions_when_interpreted(request):
    program = request.path.with_name("interpreted_kernels.py")
    environment = {**os.environ, "TRITON_INTERPRET": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    answer = subprocess.run([sys.executable, program], env=environment, capture_output=True, text=True, timeout=560)
    assert answer.returncode == 0, answer.stdout + answer.stderr
