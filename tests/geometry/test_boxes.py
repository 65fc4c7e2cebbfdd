import sys
from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest

from bevcli.errors import BevcliError
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import inverse, rigid, rotation_about_z


def some_boxes(count=5):
    random = np.random.default_rng(3)
    return Boxes3D(
        centers=random.normal(size=(count, 3)),
        sizes_lwh=random.uniform(1, 4, (count, 3)),
        yaws=random.uniform(-3, 3, count),
        velocities=random.normal(size=(count, 2)),
        classes=np.array(["car"] * count),
        scores=random.uniform(size=count),
    )


def test_corners_of_a_box_by_hand():
    box = Boxes3D(
        np.array([[10.0, 0, 1]]), np.array([[4.0, 2, 2]]), np.array([np.pi / 2]), np.zeros((1, 2)), np.array(["car"])
    )
    corners = box.corners()[0]
    assert corners[0] == pytest.approx([9, 2, 0])  # front left, bottom: ahead is +y, left is -x
    assert corners[7] == pytest.approx([11, 2, 2])  # front right, top
    assert {tuple(np.round(c, 9)) for c in corners} == {(x, y, z) for x in (9, 11) for y in (-2, 2) for z in (0, 2)}


def test_transforming_moves_corners_like_points_and_inverts():
    a_from_b = rigid((3, -1, 0.5), rotation_about_z(0.7))
    boxes = some_boxes()
    moved = boxes.transformed(a_from_b)
    assert moved.corners() == pytest.approx(boxes.corners() @ a_from_b[:3, :3].T + a_from_b[:3, 3])
    back = moved.transformed(inverse(a_from_b))
    assert back.velocities == pytest.approx(boxes.velocities)
    assert np.cos(back.yaws - boxes.yaws) == pytest.approx(1)


def test_selecting_and_concatenating_keep_columns_aligned():
    boxes = some_boxes()
    joined = Boxes3D.concatenate([boxes[[3, 1]], Boxes3D.empty(), boxes[boxes.scores > 2]])
    assert joined.centers == pytest.approx(boxes.centers[[3, 1]])
    assert joined.scores == pytest.approx(boxes.scores[[3, 1]])
    assert joined.instances is None
    assert len(Boxes3D.concatenate([])) == 0


def test_boxes_as_an_array_and_as_a_table():
    boxes = Boxes3D(
        centers=np.array([[1.0, 2.0, 3.0]]),
        sizes_lwh=np.array([[4.0, 5.0, 6.0]]),
        yaws=np.array([0.5]),
        velocities=np.array([[7.0, 8.0]]),
        classes=np.array(["car"]),
        scores=np.array([0.9]),
    )
    assert boxes.to_numpy().tolist() == [[1, 2, 3, 4, 5, 6, 0.5, 7, 8]]
    assert boxes.to_dict() == {
        "class": ["car"], "score": [0.9], "x": [1], "y": [2], "z": [3], "length": [4], "width": [5], "height": [6],
        "yaw": [0.5], "vx": [7], "vy": [8],
    }  # fmt: skip
    assert Boxes3D.empty().to_numpy().shape == (0, 9)


def test_boxes_are_a_sequence_of_single_boxes():
    boxes = some_boxes()
    first, last = boxes[0], boxes[-1]
    assert (first.class_name, first.score, first.yaw) == ("car", boxes.scores[0], boxes.yaws[0])
    assert np.array_equal(first.center, boxes.centers[0])
    assert np.array_equal(first.size_lwh, boxes.sizes_lwh[0])
    assert np.array_equal(first.velocity, boxes.velocities[0])
    assert first.columns == {}
    assert last.score == boxes.scores[4]
    assert [box.score for box in boxes] == boxes.scores.tolist()
    assert boxes[np.argmax(boxes.scores)].score == max(boxes.scores)
    assert len(boxes[1:3]) == len(boxes[[0, 4]]) == 2
    with pytest.raises(IndexError):
        boxes[5]
    tracked = replace(boxes, scores=None, instances=np.array(list("abcde")), num_points=np.arange(5))
    assert tracked[2].score is None
    assert tracked[2].columns == {"instance": "c", "num_points": 2}


def test_boxes_become_a_table_of_pandas(monkeypatch):
    boxes = some_boxes()
    monkeypatch.setitem(sys.modules, "pandas", None)  # as if it were not installed
    with pytest.raises(BevcliError, match=r"pandas is not installed: run pip install pandas, or use `to_dict\(\)`"):
        boxes.to_pandas()
    pandas = ModuleType("pandas")
    pandas.DataFrame = lambda columns: columns
    monkeypatch.setitem(sys.modules, "pandas", pandas)
    assert boxes.to_pandas() == boxes.to_dict()


def test_boxes_are_described_in_one_line():
    boxes = replace(some_boxes(3), classes=np.array(["car", "bus", "bus"]))
    assert repr(boxes) == "Boxes3D(3 boxes: 2 bus, 1 car)"
    assert repr(Boxes3D.empty()) == "Boxes3D(0 boxes)"
    box = Boxes3D(
        np.array([[1.0, -2, 0.25]]), np.ones((1, 3)), np.array([np.pi / 2]), np.zeros((1, 2)), boxes.classes[:1]
    )
    assert repr(box[0]) == "Box3D(car at 1.0, -2.0, 0.2 m, yaw 90°)"
