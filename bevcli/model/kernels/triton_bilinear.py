"""What the Triton kernels share: the four cells around a position. Import it only where Triton is installed."""

import triton
import triton.language as tl


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
