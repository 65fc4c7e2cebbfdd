"""Every way to compute deformable attention answers the same."""

from __future__ import annotations

import pytest
import torch

from bevcli.model.deformable_attention import deformable_attention, fastest_backend

SHAPES = ((5, 7), (3, 4), (1, 1))
CELLS = sum(height * width for height, width in SHAPES)
needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA GPU")


def case(depth: int = 4, counts: tuple[int, ...] = (200, 0, 3), dtype: torch.dtype = torch.float32):
    """Places inside, on the rim and far outside."""
    random = torch.Generator().manual_seed(depth)
    queries = sum(counts)
    values = torch.randn(len(counts), CELLS, 3, depth, generator=random).to(dtype)
    locations = torch.rand(queries, 3, len(SHAPES), 2, 2, generator=random) * 1.6 - 0.3
    for place, query in zip((6.7e6, -6.7e6, 0.0, 1.0), range(queries), strict=False):
        locations[query] = place
    weights = torch.rand(queries, 3, len(SHAPES), 2, generator=random)
    return values, SHAPES, locations, weights, counts


@pytest.mark.parametrize("depth", [1, 4, 32, 33])
@pytest.mark.parametrize("backend", ["padded", "compiled"])
def test_backends_equal_map_by_map_sampling(backend, depth):
    inputs = case(depth)
    torch.testing.assert_close(deformable_attention(*inputs, backend), deformable_attention(*inputs))


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("depth", [1, 16, 33])
def test_the_compiled_loops_have_the_gradients_of_map_by_map_sampling(depth, threads, monkeypatch):
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    gradients = {}
    for backend in ("grid_sample", "compiled"):
        values, shapes, locations, weights, counts = case(depth)
        learned = [tensor.requires_grad_() for tensor in (values, locations, weights)]
        result = deformable_attention(values, shapes, locations, weights, counts, backend)
        direction = torch.randn(result.shape, generator=torch.Generator().manual_seed(1))
        gradients[backend] = torch.autograd.grad((result * direction).sum(), learned)
    for found, expected in zip(gradients["compiled"], gradients["grid_sample"], strict=True):
        inside = expected.abs() < 1e6  # the places 6.7e6 away have no meaning there
        torch.testing.assert_close(found[inside], expected[inside], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_precision_values_are_summed_in_float32(dtype):
    inputs = case(16, dtype=dtype)
    found = deformable_attention(*inputs, "compiled")
    assert found.dtype == torch.float32
    torch.testing.assert_close(found, deformable_attention(*inputs))


@pytest.mark.parametrize("backend", ["padded", "compiled"])
def test_no_query_at_all_gives_no_row(backend):
    assert deformable_attention(*case(4, (0, 0)), backend).shape == (0, 12)


def test_layouts_other_than_contiguous_are_taken():
    values, shapes, locations, weights, counts = case(8)
    strided = values.transpose(1, 2).contiguous().transpose(1, 2)
    found = deformable_attention(strided, shapes, locations, weights.movedim(0, -1).contiguous().movedim(-1, 0), counts)
    torch.testing.assert_close(deformable_attention(values, shapes, locations, weights, counts, "compiled"), found)


def test_the_result_does_not_depend_on_the_number_of_threads():
    inputs = case(32, (3000,))
    threads = torch.get_num_threads()
    results = []
    for count in (1, 3):
        torch.set_num_threads(count)
        results.append(deformable_attention(*inputs, "compiled"))
    torch.set_num_threads(threads)
    assert torch.equal(*results)


@pytest.mark.gpu
@needs_gpu
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float16])
def test_the_gpu_answers_as_the_cpu(dtype):
    gpu = torch.device("cuda")
    values, shapes, locations, weights, counts = case(32, dtype=dtype)
    on_gpu = (values.to(gpu), shapes, locations.to(gpu), weights.to(gpu), counts)
    found = deformable_attention(*on_gpu, fastest_backend(gpu)).float().cpu()
    expected = deformable_attention(values, shapes, locations, weights, counts).float()
    torch.testing.assert_close(found, expected, rtol=2e-2 if dtype != torch.float32 else 1e-4, atol=1e-3)
