"""Which pillars are drawn: all of a small grid, evenly chosen ones of a large grid."""

from __future__ import annotations

from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.transforms import Array

CELLS_A_SIDE = 25  # more pillars than this in a row would hide the image that they are drawn into


def drawn_pillars(grid: BevGrid, *, everything: bool = False) -> Array:
    """(cells, Z, 3) 3D reference points of the bev frame, metres: of each cell, or of every n-th along both sides."""
    steps = [1 if everything else max(1, -(-side // CELLS_A_SIDE)) for side in (grid.rows, grid.columns)]
    pillars = grid.pillars()[steps[0] // 2 :: steps[0], steps[1] // 2 :: steps[1]]
    return pillars.reshape(-1, grid.pillar_points, 3)
