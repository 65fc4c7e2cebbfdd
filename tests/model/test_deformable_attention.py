"""Deformable attention and convolution equal their definitions as loops; all sampling modules compute the same."""

import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import nn

import bevcli.model.kernels.compiled as compiled
from bevcli.model.deformable_attention import DeformableAttention, GridSampling, sampling_locations
from bevcli.model.deformable_convolution import ModulatedDeformableConvolution, modulated_deformable_convolution
from bevcli.model.encoder import TemporalSelfAttention
from bevcli.model.kernels.compiled import CompiledDeformableConvolution, CompiledSampling, Hits, sample_hits
from bevcli.model.kernels.loops import softmax_of_groups
from bevcli.workshop.benchmark.versions import PaddedSampling
from bevcli.workshop.training.kernels import LearnedSampling, choose_training_kernels

TWO_LEVELS = ((4, 6), (2, 3))
sample = GridSampling()


def test_sampling_equals_its_definition_as_loops() -> None:
    random = np.random.default_rng(0)
    values = random.normal(size=(2, 30, 3, 4))
    locations = random.uniform(-0.3, 1.3, size=(5, 3, 2, 2, 2))
    weights = random.random((5, 3, 2, 2))
    ours = sample(
        torch.from_numpy(values).float(),
        TWO_LEVELS,
        torch.from_numpy(locations).float(),
        torch.from_numpy(weights),
        [2, 3],
    )
    np.testing.assert_allclose(ours, _by_loops(values, locations, weights, map_of_query=[0, 0, 1, 1, 1]), atol=1e-5)


@pytest.mark.parametrize("heads", [4, 8])
def test_untrained_heads_sample_in_a_ring_with_equal_weights(heads: int) -> None:
    attention = DeformableAttention(16, 16, heads, points=3, levels=2)
    offsets, logits = attention.predict(torch.randn(5, 16))
    weights = attention.sampling.weights(logits)
    torch.testing.assert_close(weights, torch.full_like(weights, 1 / 6))
    for head in range(heads):
        angle = 2 * math.pi * head / heads
        direction = np.array([math.cos(angle), math.sin(angle)])
        direction /= abs(direction).max()
        for point in range(3):
            expected = np.broadcast_to((point + 1) * direction, (5, 1, 2, 2))
            np.testing.assert_allclose(offsets[:, head, :, :, point].detach(), expected, atol=1e-5)


def _by_loops(values: np.ndarray, locations: np.ndarray, weights: np.ndarray, map_of_query: list[int]) -> np.ndarray:
    queries, heads, levels, points = weights.shape
    out = np.zeros((queries, heads, values.shape[-1]))
    starts = [0, TWO_LEVELS[0][0] * TWO_LEVELS[0][1]]
    for query, head, level, point in np.ndindex(queries, heads, levels, points):
        height, width = TWO_LEVELS[level]
        x, y = locations[query, head, level, point] * (width, height) - 0.5
        for row, column in np.ndindex(height, width):
            share = max(0.0, 1 - abs(x - column)) * max(0.0, 1 - abs(y - row))
            value = values[map_of_query[query], starts[level] + row * width + column, head]
            out[query, head] += weights[query, head, level, point] * share * value
    return out.reshape(queries, -1)


SHAPES = ((5, 7), (3, 4), (1, 1))
PLAIN, PADDED, COMPILED = GridSampling(), PaddedSampling(), CompiledSampling()
CELLS = sum(height * width for height, width in SHAPES)
needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA GPU")


def case(depth: int = 4, counts: tuple[int, ...] = (200, 0, 3), dtype: torch.dtype = torch.float32):
    """Locations inside a map, on its rim and far outside."""
    random = torch.Generator().manual_seed(depth)
    queries = sum(counts)
    values = torch.randn(len(counts), CELLS, 3, depth, generator=random).to(dtype)
    locations = torch.rand(queries, 3, len(SHAPES), 2, 2, generator=random) * 1.6 - 0.3
    for xy, query in zip((6.7e6, -6.7e6, 0.0, 1.0), range(queries), strict=False):
        locations[query] = xy
    weights = torch.rand(queries, 3, len(SHAPES), 2, generator=random)
    return values, SHAPES, locations, weights, counts


@pytest.mark.parametrize("depth", [1, 4, 8, 32, 33, 48, 64])
@pytest.mark.parametrize("sampling", [PADDED, COMPILED])
def test_sampling_modules_equal_the_plain_one(sampling, depth):
    inputs = case(depth)
    torch.testing.assert_close(sampling(*inputs), PLAIN(*inputs))


@pytest.mark.parametrize("depth", [8, 33])
def test_hits_are_sampled_as_by_their_locations_and_weights(depth):
    values, shapes, _, logits, counts = case(depth)
    random = torch.Generator().manual_seed(0)
    points, count = torch.rand(sum(counts), 2, 2, generator=random), sum(counts)
    cells = torch.randperm(count, generator=random)
    hits = Hits(cells, points, counts, torch.randint(2, (count,), generator=random))
    logits = 50 * torch.stack([logits, logits.flip(0)], dim=2)  # two predictions, each for its own map
    offsets = 3 * torch.randn(*logits.shape, 2, generator=random)
    weights = logits.flatten(-2).softmax(-1).view_as(logits)
    found = [each[cells, :, hits.prediction] for each in (offsets, weights)]
    locations = sampling_locations(points[:, None, None], found[0], sample.level_sizes(shapes, offsets.device))
    expected = COMPILED(values, shapes, locations, found[1], counts)
    torch.testing.assert_close(sample_hits(values, shapes, hits, offsets, logits), expected)
    logits[cells[3], :, hits.prediction[3]] = torch.nan
    is_damaged = sample_hits(values, shapes, hits, offsets, logits).isnan().any(1)
    assert is_damaged.nonzero().flatten().tolist() == [3]


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("depth", [1, 16, 33])
def test_compiled_loops_have_the_gradients_of_the_plain_module(depth, threads, monkeypatch):
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    gradients = []
    for sampling in (PLAIN, LearnedSampling()):
        values, shapes, locations, weights, counts = case(depth)
        learned = [tensor.requires_grad_() for tensor in (values, locations, weights)]
        result = sampling(values, shapes, locations, weights, counts)
        direction = torch.randn(result.shape, generator=torch.Generator().manual_seed(1))
        gradients.append(torch.autograd.grad((result * direction).sum(), learned))
    for expected, found in zip(*gradients, strict=True):
        inside = expected.abs() < 1e6  # the gradients of locations 6.7e6 away are not defined
        torch.testing.assert_close(found[inside], expected[inside], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("dtype", [torch.bfloat16, pytest.param(torch.float16, marks=pytest.mark.slow)])
def test_half_precision_values_are_summed_in_float32(dtype):
    inputs = case(16, dtype=dtype)
    found = COMPILED(*inputs)
    assert found.dtype == torch.float32
    torch.testing.assert_close(found, PLAIN(*inputs))


@pytest.mark.parametrize("sampling", [PLAIN, PADDED, COMPILED])
def test_without_queries_the_result_has_no_rows(sampling):
    assert sampling(*case(4, (0, 0))).shape == (0, 12)


def test_the_memory_layout_of_the_inputs_changes_nothing():
    values, shapes, locations, weights, counts = case(8)
    strided = values.transpose(1, 2).contiguous().transpose(1, 2)
    strided_weights = weights.movedim(0, -1).contiguous().movedim(-1, 0)
    found = COMPILED(strided, shapes, locations, strided_weights, counts)
    torch.testing.assert_close(found, PLAIN(values, shapes, locations, weights, counts))


def test_the_result_does_not_depend_on_the_number_of_threads():
    inputs = case(32, (3000,))
    threads = torch.get_num_threads()
    results = []
    for count in (1, 3):
        torch.set_num_threads(count)
        results.append(COMPILED(*inputs))
    torch.set_num_threads(threads)
    assert torch.equal(*results)


@pytest.mark.gpu
@needs_gpu
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float16])
def test_the_gpu_equals_the_cpu(dtype):
    gpu = torch.device("cuda")
    sampling = pytest.importorskip("bevcli.model.kernels.triton_attention").TritonSampling()
    values, shapes, locations, weights, counts = case(32, dtype=dtype)
    on_gpu = (values.to(gpu), shapes, locations.to(gpu), weights.to(gpu), counts)
    found = sampling(*on_gpu).float().cpu()
    expected = PLAIN(values, shapes, locations, weights, counts)
    torch.testing.assert_close(found, expected, rtol=2e-2 if dtype != torch.float32 else 1e-4, atol=1e-3)


@pytest.mark.parametrize(
    "count", [4, pytest.param(6, marks=pytest.mark.slow), pytest.param(8, marks=pytest.mark.slow), 32]
)
def test_the_compiled_softmax_equals_that_of_pytorch(count):
    logits = 50 * torch.randn(3 * count, generator=torch.Generator().manual_seed(0))
    logits[0], logits[count] = torch.nan, torch.inf
    found = logits.numpy().copy()
    softmax_of_groups(found, count, np.empty(len(found), np.int32))
    expected = logits.view(3, count).softmax(-1).flatten()
    torch.testing.assert_close(torch.from_numpy(found), expected, equal_nan=True)


CHANNELS, ROWS, COLUMNS = 8, 3, 5
CELL_COUNT = ROWS * COLUMNS


def pass_through(attention: DeformableAttention) -> None:
    """Makes an attention return the values at its reference points."""
    with torch.no_grad():
        attention.sampling_offsets.bias.zero_()
        for projection in (attention.value_projection, attention.output_projection):
            projection.weight.copy_(torch.eye(CHANNELS))
            projection.bias.zero_()


def centers() -> torch.Tensor:
    """(Y·X, 2) x and y of the cells' centres, 0 to 1 over the map."""
    x, y = (torch.arange(COLUMNS) + 0.5) / COLUMNS, (torch.arange(ROWS) + 0.5) / ROWS
    return torch.stack([x.repeat(ROWS), y.repeat_interleave(COLUMNS)], -1)


def test_shifted_reference_points_sample_neighbouring_history() -> None:
    block = TemporalSelfAttention(CHANNELS, 2, 4, (ROWS, COLUMNS), dropout=0.1).eval()
    pass_through(block.attention)
    history, current = torch.randn(1, CELL_COUNT, CHANNELS), torch.zeros(1, CELL_COUNT, CHANNELS)
    one_cell_along_x = centers() + torch.tensor([1 / COLUMNS, 0])
    reference = torch.stack([one_cell_along_x, centers()])[None]
    attended = block(current, torch.zeros(CELL_COUNT, CHANNELS), torch.stack([history, current], 1), reference)
    grid, old = attended.view(ROWS, COLUMNS, CHANNELS), history.view(ROWS, COLUMNS, CHANNELS)
    torch.testing.assert_close(grid[:, :-1], old[:, 1:] / 2, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(grid[:, -1], torch.zeros(ROWS, CHANNELS), atol=1e-5, rtol=0)


@pytest.mark.parametrize("stride", [1, 2])
def test_without_offsets_and_with_full_mask_it_is_plain(stride: int) -> None:
    torch.manual_seed(0)
    x, weight = torch.randn(2, 4, 7, 9), torch.randn(5, 4, 3, 3)
    plain = F.conv2d(x, weight, stride=stride, padding=1)
    height, width = plain.shape[-2:]
    offsets, mask = torch.zeros(2, 9, 2, height, width), torch.ones(2, 9, height, width)
    ours = modulated_deformable_convolution(x, offsets, mask, weight, stride)
    torch.testing.assert_close(ours, plain, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("stride", [1, 2])
def test_it_equals_its_definition_as_loops(stride: int) -> None:
    random = np.random.default_rng(1)
    x, weight = random.normal(size=(3, 6, 7)), random.normal(size=(2, 3, 3, 3))
    out_height, out_width = (6 - 1) // stride + 1, (7 - 1) // stride + 1
    offsets = 2.5 * random.normal(size=(9, 2, out_height, out_width))
    mask = random.random((9, out_height, out_width))
    expected = _convolution_by_loops(x, offsets, mask, weight, stride)
    ours = modulated_deformable_convolution(
        *(torch.from_numpy(array).float()[None] for array in (x, offsets, mask)),
        torch.from_numpy(weight).float(),
        stride,
    )
    np.testing.assert_allclose(ours[0].numpy(), expected, atol=1e-4)


def test_the_predicted_channels_are_pairs_of_dy_dx_then_the_mask() -> None:
    layer = ModulatedDeformableConvolution(1, 1)
    with torch.no_grad():
        layer.weight.zero_()
        layer.weight[0, 0, 1, 1] = 1  # only the middle tap, the fifth
        layer.offset_and_mask.bias[2 * 4] = 2  # dy of the fifth tap
        layer.offset_and_mask.bias[2 * 4 + 1] = -1  # dx of the fifth tap
        layer.offset_and_mask.bias[18 + 4] = 100  # its mask, 1 after the sigmoid
        x = torch.randn(1, 1, 6, 6)
        torch.testing.assert_close(layer(x)[0, 0, :4, 1:], x[0, 0, 2:, :5], atol=1e-4, rtol=1e-4)


def _convolution_by_loops(
    x: np.ndarray, offsets: np.ndarray, mask: np.ndarray, weight: np.ndarray, stride: int
) -> np.ndarray:
    out = np.zeros((len(weight), *mask.shape[1:]))
    for row, column in np.ndindex(*mask.shape[1:]):
        for tap in range(9):
            y = row * stride + tap // 3 - 1 + offsets[tap, 0, row, column]
            x_ = column * stride + tap % 3 - 1 + offsets[tap, 1, row, column]
            value = mask[tap, row, column] * _bilinear(x, y, x_)
            out[:, row, column] += weight[:, :, tap // 3, tap % 3] @ value
    return out


def _bilinear(x: np.ndarray, y: float, x_: float) -> np.ndarray:
    """x: (C, H, W) at a location in cells, zero outside."""
    value = np.zeros(len(x))
    top, left = int(np.floor(y)), int(np.floor(x_))
    for i, j in ((top, left), (top, left + 1), (top + 1, left), (top + 1, left + 1)):
        if 0 <= i < x.shape[1] and 0 <= j < x.shape[2]:
            value += x[:, i, j] * (1 - abs(y - i)) * (1 - abs(x_ - j))
    return value


def plain_layer(stride: int) -> ModulatedDeformableConvolution:
    random = torch.Generator().manual_seed(stride)
    layer = ModulatedDeformableConvolution(6, 5, stride)
    layer.bias = nn.Parameter(torch.empty(5))
    for parameter in layer.requires_grad_(False).parameters():
        parameter.copy_(0.5 * torch.randn(parameter.shape, generator=random))
    return layer


def image() -> torch.Tensor:
    return torch.randn(2, 6, 15, 11, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("stride", [1, 2])
@pytest.mark.parametrize("tile_bytes", [1, 20_000, 8 << 20])
def test_compiled_equals_plain(monkeypatch, stride, tile_bytes):
    plain, x = plain_layer(stride), image()
    monkeypatch.setattr(compiled, "TILE_BYTES", tile_bytes)
    fast = CompiledDeformableConvolution(plain)
    torch.testing.assert_close(fast(x), plain(x), atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(fast(x.to(memory_format=torch.channels_last)), plain(x), atol=1e-4, rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_precision_stays_near(dtype):
    plain, x = plain_layer(1), image()
    expected = plain(x.to(dtype).float())
    found = CompiledDeformableConvolution(plain).to(dtype)(x.to(dtype))
    assert found.dtype == dtype
    assert (found.float() - expected).norm() < 0.03 * expected.norm()


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA GPU")
@pytest.mark.parametrize("stride", [1, 2])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float16])
def test_results_and_gradients_on_a_gpu_equal_the_cpu(stride, dtype):
    found = []
    for device in (torch.device("cpu"), torch.device("cuda")):
        layer = plain_layer(stride).to(dtype).to(device, torch.float32 if device.type == "cpu" else dtype)
        x = image().to(dtype).to(layer.weight)
        layer.weight.requires_grad = True
        choose_training_kernels(layers := nn.Sequential(layer), device)
        result = layers(x.requires_grad_())
        gradients = torch.autograd.grad(result.square().sum(), (x, layer.weight))
        found.append([each.float().cpu() for each in (result, *gradients)])
    for expected, equal in zip(*found, strict=True):
        # PyTorch rounds the products of the convolution that predicts offsets to TF32.
        assert (equal - expected).norm() < (0.01 if dtype == torch.float32 else 0.05) * expected.norm()
