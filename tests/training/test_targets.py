"""Targets of a frame: boxes in range, and masks against masks made by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from bevcli.errors import InputError
from bevcli.frame import BevMap
from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.boxes import Boxes3D
from bevcli.workshop.training.targets import detection_targets, segmentation_targets

GRID = BevGrid(4, 8, x_range_m=(-8, 8), y_range_m=(-4, 4))  # cells of 2 m


def boxes(*rows: tuple[str, float, float, float], num_points: list[int] | None = None) -> Boxes3D:
    """Rows of class, x, y, yaw; 4 m long, 2 m wide."""
    names, xs, ys, yaws = zip(*rows, strict=True)
    count = len(rows)
    return Boxes3D(
        centers=np.stack([xs, ys, np.zeros(count)], -1).astype(float),
        sizes_lwh=np.tile([4.0, 2.0, 1.5], (count, 1)),
        yaws=np.array(yaws, dtype=float),
        velocities=np.zeros((count, 2)),
        classes=np.array(names),
        num_points=None if num_points is None else np.array(num_points),
    )


def test_boxes_out_of_range_class_or_points_are_no_targets(mini_config) -> None:
    config = replace(mini_config, classes=("car", "pedestrian"))
    truth = boxes(
        ("pedestrian", 1, 2, 0),
        ("car", 30, 0, 0),
        ("bus", 0, 0, 0),
        ("car", 5, 5, 0),
        ("car", 6, 5, 0),
        num_points=[3, 9, 9, -1, 0],
    )
    targets = detection_targets(truth, config)
    assert targets.labels.tolist() == [1, 0]
    assert targets.codes[:, :2].tolist() == [[1, 2], [5, 5]]


def test_a_vehicle_covers_the_cells_under_it() -> None:
    along_y = boxes(("car", 1.0, 0.0, np.pi / 2), ("pedestrian", -5.0, 1.0, 0.0))
    targets = segmentation_targets(along_y, None, GRID)
    assert targets.stuff is None
    expected = torch.zeros(1, 4, 8)
    expected[0, 1:3, 4] = 1  # x 0 to 2, y -2 to 2
    assert torch.equal(targets.things, expected.flatten(1))
    assert targets.locations.tolist() == [pytest.approx([9 / 16, 0.5, 2 / 16, 4 / 8])]


def test_a_vehicle_smaller_than_a_cell_covers_one() -> None:
    bicycle = replace(boxes(("bicycle", 0.2, 0.2, 0.3)), sizes_lwh=np.array([[0.5, 0.3, 1.0]]))
    targets = segmentation_targets(bicycle, None, GRID)
    assert targets.things.nonzero().tolist() == [[0, 2 * 8 + 4]]


def test_a_class_needs_a_minimum_share_of_a_cell() -> None:
    cells = np.zeros((8, 16), dtype=np.uint8)  # cells of 1 m; the first row has the largest y
    cells[:2] = 1  # y 2 to 4, the last row of the grid: all road
    cells[2, :2] = 4  # a crossing on half of the cell at the smallest x, y 0 to 2
    cells[4, :1] = 4  # a crossing on a quarter of the cell below: too little
    cells[7, 15] = 2  # a lane boundary on a quarter of the cell at the largest x, smallest y; enough for lines
    stuff = segmentation_targets(Boxes3D.empty(), BevMap(cells, (-8, 8), (-4, 4)), GRID).stuff
    assert stuff is not None
    road, line, crossing = stuff.reshape(3, 4, 8)
    assert road[3].all()
    assert not road[:3].any()
    assert line.nonzero().tolist() == [[0, 7]]
    assert crossing.nonzero().tolist() == [[2, 0]]


def test_a_map_smaller_than_the_grid_is_rejected() -> None:
    with pytest.raises(InputError, match="covers x -6 to 6 m, but the model's BEV grid -8 to 8 m"):
        segmentation_targets(Boxes3D.empty(), BevMap(np.zeros((4, 4), np.uint8), (-6, 6), (-4, 4)), GRID)


def test_the_bits_of_a_map_are_those_that_it_states() -> None:
    cells = np.full((8, 16), 2, dtype=np.uint8)
    crossings = BevMap(cells, (-8, 8), (-4, 4), {"kerb": 1, "pedestrian_crossing": 2})
    stuff = segmentation_targets(Boxes3D.empty(), crossings, GRID).stuff
    assert stuff is not None
    assert stuff.any(dim=1).tolist() == [False, False, True]


def test_a_map_without_any_class_of_the_head_is_rejected() -> None:
    kerbs = BevMap(np.zeros((8, 16), np.uint8), (-8, 8), (-4, 4), {"kerb": 1})
    with pytest.raises(InputError, match="has the classes kerb, but the segmentation head learns drivable_road"):
        segmentation_targets(Boxes3D.empty(), kerbs, GRID)
