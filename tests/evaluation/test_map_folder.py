"""Map folders: what is written is read back, and mistakes are named."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from bevcli.errors import InputError
from bevcli.frame import BevMap
from bevcli.sequences.files.map_folder import open_maps, write_map

MAP = BevMap(np.arange(12, dtype=np.uint8).reshape(3, 4), (-32.0, 32.0), (-24.0, 24.0))


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    write_map(tmp_path / "maps", 7, MAP)
    folder = open_maps(tmp_path / "maps")
    assert folder.has(7)
    assert not folder.has(8)
    assert folder.classes == {"drivable_road": 1, "lane_boundary": 2, "pedestrian_crossing": 4, "vehicle": 8}
    found = folder.load(7)
    np.testing.assert_array_equal(found.cells, MAP.cells)
    assert (found.x_range_m, found.y_range_m) == (MAP.x_range_m, MAP.y_range_m)


def test_maps_of_another_extent_do_not_mix(tmp_path: Path) -> None:
    write_map(tmp_path, 0, MAP)
    with pytest.raises(InputError, match="write it to another folder"):
        write_map(tmp_path, 1, BevMap(MAP.cells, (-50.0, 50.0), (-24.0, 24.0)))
    assert not open_maps(tmp_path).has(1)


def test_maps_with_classes_of_their_own_are_read_back(tmp_path: Path) -> None:
    classes = {name: 1 << index for index, name in enumerate("abcdefgh")}
    cells = np.array([[255, 128], [1, 0]], dtype=np.uint8)
    write_map(tmp_path, 0, BevMap(cells, (-1.0, 1.0), (-1.0, 1.0), classes))
    found = open_maps(tmp_path).load(0)
    assert found.classes == classes
    assert found.layer("h").tolist() == [[True, True], [False, False]]
    assert found.layer("a").tolist() == [[True, False], [True, False]]
    assert not found.layer("vehicle").any()


def test_classes_are_in_the_order_of_their_bits(tmp_path: Path) -> None:
    write_map(tmp_path, 0, BevMap(np.zeros((2, 2), np.uint8), (-1.0, 1.0), (-1.0, 1.0), {"line": 16, "road": 2}))
    assert list(open_maps(tmp_path).classes) == ["road", "line"]


def test_maps_of_other_classes_do_not_mix(tmp_path: Path) -> None:
    write_map(tmp_path, 0, MAP)
    with pytest.raises(InputError, match=r"states .*drivable_road.*, but the new map has .*'line'.*: write it"):
        write_map(tmp_path, 1, BevMap(MAP.cells, MAP.x_range_m, MAP.y_range_m, {"line": 1}))


def test_a_missing_or_wrong_image_is_named(tmp_path: Path) -> None:
    write_map(tmp_path, 0, MAP)
    folder = open_maps(tmp_path)
    with pytest.raises(InputError, match=r"000001\.png: the map of frame 1 is missing"):
        folder.load(1)
    cv2.imwrite(str(tmp_path / "000002.png"), np.zeros((3, 4, 3), np.uint8))
    with pytest.raises(InputError, match=r"000002\.png: expected an 8-bit image with one channel"):
        folder.load(2)
    cv2.imwrite(str(tmp_path / "000003.png"), np.full((3, 4), 16, np.uint8))
    with pytest.raises(InputError, match="bits 0x10 belong to no class"):
        folder.load(3)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("format", "map", '"format" must be "bevcli-map/1"'),
        ("x_range_m", [3, 1], '"x_range_m" must be two numbers'),
        ("y_range_m", None, '"y_range_m" must be two numbers'),
        ("classes", {"3": "drivable_road"}, '"classes" must name bits'),
        ("classes", {"256": "drivable_road"}, '"classes" must name bits'),
        ("classes", {"1": "road", "2": "road"}, '"classes" must name bits'),
        ("classes", {"1": ""}, '"classes" must name bits'),
        ("classes", {"1": "road\x1b[2J"}, '"classes" must name bits'),
        ("classes", {"1": ["road"]}, '"classes" must name bits'),
        ("classes", {}, '"classes" must name bits'),
    ],
)
def test_a_wrong_legend_is_named(tmp_path: Path, key: str, value: object, message: str) -> None:
    write_map(tmp_path, 0, MAP)
    legend = json.loads((tmp_path / "map.json").read_text())
    (tmp_path / "map.json").write_text(json.dumps({**legend, key: value}))
    with pytest.raises(InputError, match=message):
        open_maps(tmp_path)
