import numpy as np
import pytest

from bevcli.geometry.bev_grid import BevGrid


def test_cells_of_a_small_grid_by_hand():
    grid = BevGrid(rows=2, columns=4, x_range_m=(-4, 4), y_range_m=(-1, 1))
    assert grid.cell_size_m == (2, 1)
    assert grid.cell_centers()[0, 0] == pytest.approx([-3, -0.5])
    assert grid.cell_centers()[1, 3] == pytest.approx([3, 0.5])


def test_cell_of_a_centre_is_its_cell_outside_points_have_none():
    grid = BevGrid(rows=5, columns=7)
    rows, columns = np.indices((5, 7))
    assert (grid.cell_of(grid.cell_centers()) == np.stack([rows, columns], axis=-1)).all()
    assert grid.cell_of([[-51.3, 0], [0, 51.3]]).tolist() == [[-1, -1], [-1, -1]]


def test_pillars_stand_on_the_centres_at_the_published_heights():
    pillars = BevGrid(rows=50, columns=50).pillars()
    assert pillars.shape == (50, 50, 4, 3)
    assert pillars[0, 0, :, 2] == pytest.approx([-4.5, -4.5 + 7 / 3, -4.5 + 14 / 3, 2.5])
    assert pillars[49, 0, 0, :2] == pytest.approx([-50.176, 50.176])
