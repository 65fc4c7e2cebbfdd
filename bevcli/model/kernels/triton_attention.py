"""Deformable attention on a GPU as one Triton kernel. Import it only where Triton is installed."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from itertools import accumulate

import torch
import triton
import triton.language as tl
from torch import Tensor, nn

from bevcli.model.deformable_attention import LevelShapes
from bevcli.model.upload import upload

QUERIES_PER_PROGRAM = 32


class TritonSampling(nn.Module):
    """Takes the place of `GridSampling` on a GPU, without gradients."""

    def forward(
        self,
        values: Tensor,
        level_shapes: LevelShapes,
        locations: Tensor,
        weights: Tensor,
        queries_per_map: Sequence[int],
    ) -> Tensor:
        """Arguments and result as for `GridSampling`."""
        maps, cells, heads, depth = values.shape
        queries, _, levels, points, _ = locations.shape
        ends = _table(tuple(accumulate(queries_per_map)), values.device)
        shapes = _table(level_shapes, values.device)
        out = values.new_empty(queries, heads, depth, dtype=torch.float32)
        if queries:
            # Triton launches on the current GPU, which need not be that of the tensors.
            with torch.cuda.device(values.device):
                _sample[(triton.cdiv(queries, QUERIES_PER_PROGRAM), heads)](
                    values.contiguous(),
                    shapes,
                    locations.float().contiguous(),
                    weights.float().contiguous(),
                    ends,
                    out,
                    queries,
                    maps,
                    cells,
                    **constants(heads, depth, levels, points),
                )
        return out.flatten(1)


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
    map_of_query = tl.zeros((BLOCK,), tl.int64)
    for index in range(maps - 1):
        map_of_query += (query >= tl.load(ends + index)).to(tl.int64)
    first_cell = map_of_query * cells
    total = tl.zeros((BLOCK, PADDED_DEPTH), tl.float32)
    for level in range(LEVELS):
        height = tl.load(shapes + 2 * level)
        width = tl.load(shapes + 2 * level + 1)
        for point in range(POINTS):
            sample = ((query * HEADS + head) * LEVELS + level) * POINTS + point
            # Locations more than a cell outside the map contribute nothing; the clamp keeps them within an int32.
            x = tl.load(locations + 2 * sample, exists, -1.0) * width - 0.5
            y = tl.load(locations + 2 * sample + 1, exists, -1.0) * height - 0.5
            x = tl.minimum(tl.maximum(x, -2.0), width + 1.0)
            y = tl.minimum(tl.maximum(y, -2.0), height + 1.0)
            weight = tl.load(weights + sample, exists, 0.0)
            left = tl.floor(x)
            top = tl.floor(y)
            for corner in tl.static_range(4):
                column = left + corner % 2
                row = top + corner // 2
                share = (1.0 - tl.abs(x - column)) * (1.0 - tl.abs(y - row)) * weight
                inside = exists & (column >= 0) & (column < width) & (row >= 0) & (row < height)
                cell = first_cell + row.to(tl.int64) * width + column.to(tl.int64)
                address = values + (cell[:, None] * HEADS + head) * DEPTH + channel[None, :]
                value = tl.load(address, inside[:, None] & has_channel[None, :], 0.0)
                total += share[:, None] * value.to(tl.float32)
        first_cell += height * width
    target = out + (query[:, None] * HEADS + head) * DEPTH + channel[None, :]
    tl.store(target, total, exists[:, None] & has_channel[None, :])
