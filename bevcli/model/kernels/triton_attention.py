"""Deformable attention on a GPU as one Triton kernel. Import it only where Triton is installed."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from itertools import accumulate
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from bevcli.model.deformable_attention import GridSampling, Hits, LevelShapes
from bevcli.model.upload import upload

QUERIES_PER_PROGRAM = 32


class TritonSampling(GridSampling):
    """A `GridSampling` on a GPU."""

    def forward(
        self,
        values: Tensor,
        level_shapes: LevelShapes,
        locations: Tensor,
        weights: Tensor,
        queries_per_map: Sequence[int],
    ) -> Tensor:
        """As `GridSampling.forward`."""
        sums = _WeightedSums.apply(values, locations, weights, level_shapes, tuple(queries_per_map))
        return sums.flatten(1)


def sample_hits(values: Tensor, level_shapes: LevelShapes, hits: Hits, offsets: Tensor, logits: Tensor) -> Tensor:
    """As `compiled.sample_hits`, on a GPU. No gradients."""
    maps, cells, heads, depth = values.shape
    predictions, levels, points = logits.shape[2:]
    out = values.new_empty(len(hits.query), heads, depth, dtype=torch.float32)
    if len(out):
        # Triton launches on the current GPU, which need not be that of the tensors.
        with torch.cuda.device(values.device):
            _sample_hits[(triton.cdiv(len(out), QUERIES_PER_PROGRAM), heads)](
                values.contiguous(),
                _table(level_shapes, values.device),
                hits.reference_points.float().contiguous(),
                offsets.float().contiguous(),
                logits.float().contiguous(),
                hits.query,
                hits.prediction,
                _table(tuple(accumulate(hits.hits_per_map)), values.device),
                out,
                len(out),
                maps,
                cells,
                PREDICTIONS=predictions,
                PILLAR_POINTS=hits.reference_points.shape[1],
                SAMPLES=triton.next_power_of_2(levels * points),
                **constants(heads, depth, levels, points),
            )
    return out.flatten(1)


class _WeightedSums(torch.autograd.Function):
    """The sums (M, heads, D) float32, and their gradients."""

    @staticmethod
    def forward(
        context: Any,
        values: Tensor,
        locations: Tensor,
        weights: Tensor,
        level_shapes: LevelShapes,
        queries_per_map: tuple[int, ...],
    ) -> Tensor:
        read = (values.contiguous(), locations.float().contiguous(), weights.float().contiguous())
        context.save_for_backward(*read)
        context.dtypes = (values.dtype, locations.dtype, weights.dtype)
        ends = _table(tuple(accumulate(queries_per_map)), values.device)
        context.tables = (_table(level_shapes, values.device), ends)
        out = values.new_empty(len(locations), *values.shape[2:], dtype=torch.float32)
        _launch(_sample, *read, context.tables, out)
        return out

    @staticmethod
    def backward(context: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        read = context.saved_tensors
        results = (torch.zeros_like(read[0], dtype=torch.float32), *map(torch.empty_like, read[1:]))
        _launch(_sample_backward, *read, context.tables, gradients[0].contiguous(), *results)
        learned = (result.to(dtype) for result, dtype in zip(results, context.dtypes, strict=True))
        return *learned, None, None


def _launch(
    kernel: Any, values: Tensor, locations: Tensor, weights: Tensor, tables: tuple[Tensor, Tensor], *others: Tensor
) -> None:
    maps, cells, heads, depth = values.shape
    queries, _, levels, points, _ = locations.shape
    shapes, ends = tables
    if queries:
        # Triton launches on the current GPU, which need not be that of the tensors.
        with torch.cuda.device(values.device):
            kernel[(triton.cdiv(queries, QUERIES_PER_PROGRAM), heads)](
                values,
                shapes,
                locations,
                weights,
                ends,
                *others,
                queries,
                maps,
                cells,
                **constants(heads, depth, levels, points),
            )


@cache
def _table(rows: tuple[int, ...] | LevelShapes, device: torch.device) -> Tensor:
    """The rows as int32 on a device. Equal tables, as all layers and frames need them, are uploaded once.

    None is given up, because CUDA graphs hold their addresses.
    """
    return upload(torch.tensor(rows, dtype=torch.int32), device)


def constants(heads: int, depth: int, levels: int, points: int) -> dict[str, int]:
    """The arguments of the kernel that it is compiled for. depth: channels of a head."""
    padded = triton.next_power_of_2(depth)
    counts = {"HEADS": heads, "DEPTH": depth, "PADDED_DEPTH": padded, "LEVELS": levels, "POINTS": points}
    return {**counts, "BLOCK": QUERIES_PER_PROGRAM}


@triton.jit
def _sample(  # type: ignore[no-untyped-def]
    values,
    shapes,
    locations,
    weights,
    ends,
    out,
    queries,
    maps,
    cells,
    HEADS: tl.constexpr,
    DEPTH: tl.constexpr,
    PADDED_DEPTH: tl.constexpr,
    LEVELS: tl.constexpr,
    POINTS: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """One program sums the samples of BLOCK queries in one head; tensors are laid out as for `GridSampling`.

    ends: (maps,) int32, for each map the number of queries up to and with its own.
    """
    query = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    head = tl.program_id(1)
    channel = tl.arange(0, PADDED_DEPTH)
    exists = query < queries
    has_channel = channel < DEPTH
    first_cell = _map_of(query, ends, maps, BLOCK) * cells
    total = tl.zeros((BLOCK, PADDED_DEPTH), tl.float32)
    for level in range(LEVELS):
        height = tl.load(shapes + 2 * level)
        width = tl.load(shapes + 2 * level + 1)
        for point in range(POINTS):
            sample = ((query * HEADS + head) * LEVELS + level) * POINTS + point
            y, x = _position(locations, sample, exists, height, width)
            weight = tl.load(weights + sample, exists, 0.0)
            for corner in tl.static_range(4):
                cell, of_rows, of_columns, inside = corner_of(first_cell, y, x, exists, height, width, corner)
                address = values + (cell[:, None] * HEADS + head) * DEPTH + channel[None, :]
                value = tl.load(address, inside[:, None] & has_channel[None, :], 0.0)
                total += (of_columns * of_rows * weight)[:, None] * value.to(tl.float32)
        first_cell += height * width
    target = out + (query[:, None] * HEADS + head) * DEPTH + channel[None, :]
    tl.store(target, total, exists[:, None] & has_channel[None, :])


@triton.jit
def _sample_hits(  # type: ignore[no-untyped-def]
    values,
    shapes,
    reference_points,
    offsets,
    logits,
    query_of_hit,
    prediction_of_hit,
    ends,
    out,
    hits,
    maps,
    cells,
    PREDICTIONS: tl.constexpr,
    PILLAR_POINTS: tl.constexpr,
    SAMPLES: tl.constexpr,
    HEADS: tl.constexpr,
    DEPTH: tl.constexpr,
    PADDED_DEPTH: tl.constexpr,
    LEVELS: tl.constexpr,
    POINTS: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """One program sums the samples of BLOCK hits in one head; tensors are laid out as for `sample_hits`.

    ends: (maps,) int32, for each map the number of hits up to and with its own. SAMPLES: at least LEVELS · POINTS.
    """
    hit = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    head = tl.program_id(1)
    channel = tl.arange(0, PADDED_DEPTH)
    exists = hit < hits
    has_channel = channel < DEPTH
    first_cell = _map_of(hit, ends, maps, BLOCK) * cells
    query = tl.load(query_of_hit + hit, exists, 0)
    prediction = (query * HEADS + head) * PREDICTIONS + tl.load(prediction_of_hit + hit, exists, 0)
    first_sample = prediction * (LEVELS * POINTS)
    sample = tl.arange(0, SAMPLES)
    is_sample = exists[:, None] & (sample < LEVELS * POINTS)[None, :]
    all_logits = tl.load(logits + first_sample[:, None] + sample[None, :], is_sample, float("-inf"))
    largest = tl.where(exists, tl.max(all_logits, 1), 0.0)
    sum_of_weights = tl.sum(tl.exp(all_logits - largest[:, None]), 1)
    total = tl.zeros((BLOCK, PADDED_DEPTH), tl.float32)
    for level in range(LEVELS):
        height = tl.load(shapes + 2 * level)
        width = tl.load(shapes + 2 * level + 1)
        for point in range(POINTS):
            element = first_sample + level * POINTS + point
            reference = reference_points + 2 * (hit * PILLAR_POINTS + point % PILLAR_POINTS)
            x = tl.load(reference, exists, -1.0) + tl.load(offsets + 2 * element, exists, 0.0) / width
            y = tl.load(reference + 1, exists, -1.0) + tl.load(offsets + 2 * element + 1, exists, 0.0) / height
            y, x = _cells(y, x, height, width)
            weight = tl.exp(tl.load(logits + element, exists, 0.0) - largest) / sum_of_weights
            for corner in tl.static_range(4):
                cell, of_rows, of_columns, inside = corner_of(first_cell, y, x, exists, height, width, corner)
                address = values + (cell[:, None] * HEADS + head) * DEPTH + channel[None, :]
                value = tl.load(address, inside[:, None] & has_channel[None, :], 0.0)
                total += (of_columns * of_rows * weight)[:, None] * value.to(tl.float32)
        first_cell += height * width
    target = out + (hit[:, None] * HEADS + head) * DEPTH + channel[None, :]
    tl.store(target, total, exists[:, None] & has_channel[None, :])


@triton.jit
def _sample_backward(  # type: ignore[no-untyped-def]
    values,
    shapes,
    locations,
    weights,
    ends,
    out_gradient,
    values_gradient,
    locations_gradient,
    weights_gradient,
    queries,
    maps,
    cells,
    HEADS: tl.constexpr,
    DEPTH: tl.constexpr,
    PADDED_DEPTH: tl.constexpr,
    LEVELS: tl.constexpr,
    POINTS: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """As `_sample`: adds to values_gradient, and writes the other gradients, all float32."""
    query = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)).to(tl.int64)
    head = tl.program_id(1)
    channel = tl.arange(0, PADDED_DEPTH)
    exists = query < queries
    has_channel = channel < DEPTH
    first_cell = _map_of(query, ends, maps, BLOCK) * cells
    source = out_gradient + (query[:, None] * HEADS + head) * DEPTH + channel[None, :]
    gradient = tl.load(source, exists[:, None] & has_channel[None, :], 0.0)
    for level in range(LEVELS):
        height = tl.load(shapes + 2 * level)
        width = tl.load(shapes + 2 * level + 1)
        for point in range(POINTS):
            sample = ((query * HEADS + head) * LEVELS + level) * POINTS + point
            y, x = _position(locations, sample, exists, height, width)
            weight = tl.load(weights + sample, exists, 0.0)
            of_y = tl.zeros((BLOCK,), tl.float32)
            of_x = tl.zeros((BLOCK,), tl.float32)
            of_weight = tl.zeros((BLOCK,), tl.float32)
            for corner in tl.static_range(4):
                cell, of_rows, of_columns, inside = corner_of(first_cell, y, x, exists, height, width, corner)
                element = (cell[:, None] * HEADS + head) * DEPTH + channel[None, :]
                read = inside[:, None] & has_channel[None, :]
                share = of_columns * of_rows
                tl.atomic_add(values_gradient + element, (share * weight)[:, None] * gradient, read, "relaxed")
                product = tl.sum(tl.load(values + element, read, 0.0).to(tl.float32) * gradient, 1)
                of_weight += share * product
                of_y += (corner // 2 * 2 - 1) * of_columns * product
                of_x += (corner % 2 * 2 - 1) * of_rows * product
            tl.store(weights_gradient + sample, of_weight, exists)
            tl.store(locations_gradient + 2 * sample, of_x * weight * width, exists)
            tl.store(locations_gradient + 2 * sample + 1, of_y * weight * height, exists)
        first_cell += height * width


@triton.jit
def _map_of(query, ends, maps, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    """Index of the map that each query samples."""
    map_of_query = tl.zeros((BLOCK,), tl.int64)
    for index in range(maps - 1):
        map_of_query += (query >= tl.load(ends + index)).to(tl.int64)
    return map_of_query


@triton.jit
def _position(locations, sample, exists, height, width):  # type: ignore[no-untyped-def]
    """y and x of samples, in cells of a level."""
    x = tl.load(locations + 2 * sample, exists, -1.0)
    y = tl.load(locations + 2 * sample + 1, exists, -1.0)
    return _cells(y, x, height, width)


@triton.jit
def _cells(y, x, height, width):  # type: ignore[no-untyped-def]
    """y and x, 0 to 1 over a level, in its cells, 0 at the centre of the first."""
    # Locations more than a cell outside the map contribute nothing; the clamp keeps them within an int32.
    y, x = y * height - 0.5, x * width - 0.5
    return tl.minimum(tl.maximum(y, -2.0), height + 1.0), tl.minimum(tl.maximum(x, -2.0), width + 1.0)


@triton.jit
def corner_of(first_cell, y, x, exists, height, width, corner: tl.constexpr):  # type: ignore[no-untyped-def]
    """Index of a cell (corner 0 to 3) around positions y, x, its shares of rows and columns, whether it exists.

    Positions are float32 in cells, 0 at the centre of the first, at most 2 cells outside a map whose first cell has the
    index first_cell. A cell exists where the position does and the cell lies in the map.
    """
    row = tl.floor(y) + corner // 2
    column = tl.floor(x) + corner % 2
    inside = exists & (row >= 0) & (row < height) & (column >= 0) & (column < width)
    cell = first_cell + (row.to(tl.int32) * width + column.to(tl.int32))
    return cell, 1.0 - tl.abs(y - row), 1.0 - tl.abs(x - column), inside
