"""Limits of what is parsed: sizes, depths, numbers and cells."""

import csv
import os
import time
import tracemalloc
from dataclasses import replace

import pytest
from memory_drive import MemoryDrive, make_rig
from recorded_drive import boxes_ahead

from bevcli.errors import ConfigError, InputError, WeightsError
from bevcli.frame import FrameStamp
from bevcli.geometry.transforms import Pose
from bevcli.parsing.documents import parse_json, parse_toml, read_csv, read_json
from bevcli.parsing.files import hash_of_file, read_bytes
from bevcli.printing import cell_of, name_of
from bevcli.sequences.files.boxes_file import BoxesFile, FrameBoxes
from bevcli.sequences.files.boxes_table import write_csv
from bevcli.sequences.files.json_fields import array_of_numbers
from bevcli.sequences.open import open_sequence
from bevcli.workshop.formats.markup import parse_xml, read_yaml
from bevcli.workshop.formats.output import NativeWriter


def refused(function, *arguments, error=InputError, **options):
    """The message; it names the file."""
    began = time.process_time()
    with pytest.raises(error) as caught:
        function(*arguments, **options)
    assert "file" in str(caught.value)
    assert time.process_time() - began < 5
    return str(caught.value)


@pytest.mark.parametrize("levels", [65, 1000, 100_000])
@pytest.mark.parametrize(("start", "end"), [(b"[", b"]"), (b'{"a":', b"}")])
def test_deep_json_is_refused(levels, start, end):
    text = start * levels + b"1" + end * levels
    assert "nested too deeply" in refused(parse_json, text, "file")
    assert "nested too deeply" in refused(parse_json, start * levels, "file")


@pytest.mark.parametrize("number", ["9" * 19, "-" + "9" * 30, "1" * 4301, "1" * 1_000_000])
def test_integers_beyond_62_bits_are_refused_in_every_format(tmp_path, number):
    path = tmp_path / "file"
    assert "large" in refused(parse_json, f'{{"a": [{number}]}}'.encode(), path)
    refused(parse_toml, f"a = {number}", path, ConfigError, error=ConfigError)
    path.write_text(f"a: {number}")
    if len(number) < 200_000:
        refused(read_yaml, path)
    path.write_text(f"a\n{number}\n")
    refused(lambda: read_csv(path, ("a",))[0].integer("a"))


def test_long_fractions_and_the_largest_integers_are_read():
    text = b"[0.12345678901234567890123, 4611686018427387904, -4611686018427387904]"
    assert parse_json(text, "file") == [0.12345678901234567890123, 2**62, -(2**62)]
    for value in ([1.0, True], [[0, False]], [1, "1"], [[1], [1, 2]]):
        assert array_of_numbers(value) is None
    refused(parse_json, b'["\\ud800"]', "file")  # half a character
    assert parse_json(b'["\\ud83d\\ude00"]', "file") == ["\N{GRINNING FACE}"]
    text = b'{"a": "' + b"[" * 1000 + b'\\"[", "b": [' + b'"{", ' * 100 + b"1]}"  # brackets in a text are no nesting
    assert parse_json(text, "file")["b"][-1] == 1


@pytest.mark.parametrize(
    "text",
    [
        "[" * 100_000,
        "a: " * 10_000,
        "- " * 10_000,
        "a: &x [*x]",
        "x: &a [1]\n" + "".join(f"x{n}: &{chr(98 + n)} [{', '.join(['*' + chr(97 + n)] * 10)}]\n" for n in range(9)),
        "a: !!python/object/apply:os.system [true]",
        "a: !!int x",
        "? {a: 1}\n: 2",
        "a: \x00",
    ],
    ids=range(9),
)
def test_odd_yaml_is_refused(tmp_path, text):
    path = tmp_path / "file.yaml"
    path.write_text(text)
    refused(read_yaml, path)


@pytest.mark.parametrize(
    "text",
    [
        "".join(
            f"a{n}: &a{n} {{<<: [{', '.join([f'*a{n - 1}'] * 10)}]}}\n" if n else "a0: &a0 {x: 1}\n" for n in range(10)
        ),
        f"a: &a {{{', '.join(f'k{n}: 1' for n in range(500))}}}\nb: {{<<: [{', '.join(['*a'] * 1500)}]}}",
    ],
    ids=["deep", "wide"],
)
def test_a_bomb_of_merges_ends_while_it_is_parsed(tmp_path, text):
    path = tmp_path / "file.yaml"
    path.write_text(text)
    tracemalloc.start()
    try:
        assert "more than 200000 values, merges written out" in refused(read_yaml, path)
        assert tracemalloc.get_traced_memory()[1] < 100 << 20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("text", "line", "key"),
    [
        ("a: 1\nb: 2\na: 3", 3, "a"),
        ("x:\n  - {c: 1,\n     d: {e: 1, e: 2}}", 3, "e"),
        ("a: {1: x, 0x1: y}", 1, "0x1"),
        ('a: {1: x, "1": y}', 1, "1"),
        ("a: &a {x: 1}\nb: {<<: *a, y: 1, y: 2}", 2, "y"),
        ("a: !!opencv-matrix\n  rows: 1\n  rows: 2", 3, "rows"),
    ],
)
def test_a_key_twice_in_yaml_is_named(tmp_path, text, line, key):
    path = tmp_path / "file.yaml"
    path.write_text(text)
    assert f'line {line}: "{key}" appears twice in the same mapping' in refused(read_yaml, path)


def test_a_merge_may_be_overridden_and_an_exponent_makes_a_number(tmp_path):
    path = tmp_path / "file.yaml"
    path.write_text("a: &a {x: 1, y: 2}\nb: {<<: *a, x: 1e-05}\nc: [1E5, -2.e3, .5e-1, 1e5x, e5, 1.5, 0x1e5, 2e+3]\n")
    numbers = [1e5, -2e3, 0.05, "1e5x", "e5", 1.5, 0x1E5, 2e3]
    assert read_yaml(path) == {"a": {"x": 1, "y": 2}, "b": {"x": 1e-05, "y": 2}, "c": numbers}
    path.write_text("a: &x [1, 2]\nb: *x\n")  # as an alias of a plain list is read
    assert read_yaml(path) == {"a": [1, 2], "b": [1, 2]}


def test_what_only_yaml_1_1_takes_for_a_number_is_text(tmp_path):
    path = tmp_path / "file.yaml"
    texts = ["010", "00", "10:33", "1:30.5", "1_0", "0b1", "yes", "no", "off", "2024-01-02", "1.2.3", ""]
    path.write_text("\n".join(f"- {text}" for text in texts) + "\n- [0, -0, +7, 0.0, 1., .5, true, False, ~, null]\n")
    *found, values = read_yaml(path)
    assert found == [*texts[:-1], None]
    assert values == [0, 0, 7, 0.0, 1.0, 0.5, True, False, None, None]


@pytest.mark.parametrize("text", [b'{"a": 1, "b": 2, "a": 3}', b'[{"x": {"a": 1, "a": 1}}]'])
def test_a_key_twice_in_json_is_named(text):
    assert '"a" appears twice in the same object' in refused(parse_json, text, "file")


@pytest.mark.parametrize("levels", [64, 65, 100_000])
def test_deep_xml_is_refused(levels):
    text = b"<a>" * levels + b"</a>" * levels
    if levels > 64:
        assert "nested too deeply" in refused(parse_xml, text, "file")
    else:
        assert len(list(parse_xml(text, "file").iter())) == 64


@pytest.mark.parametrize("text", ["a = " + "[" * 50_000, "a = 2001-99-99", "a" + ".a" * 5000 + " = 1", "a = \x00"])
def test_odd_toml_is_refused(text):
    refused(parse_toml, text, "file")


def test_pipes_devices_folders_and_huge_files_are_refused(tmp_path):
    pipe, huge, folder = tmp_path / "file pipe", tmp_path / "huge file", tmp_path / "file folder"
    os.mkfifo(pipe)
    folder.mkdir()
    with huge.open("wb") as file:
        file.truncate(1 << 40)
    for path in (pipe, folder, tmp_path / "file missing", tmp_path / ("file" * 100), tmp_path / "file\0"):
        refused(read_bytes, path, 100)
        with pytest.raises(WeightsError):
            hash_of_file(path)
    assert "at most 64 MiB" in refused(read_json, huge)


SIGNS = ("=", "+", "-", "@", "\t", "\r")


@pytest.mark.parametrize("name", ["+1+1", "=1+1", "-1", "@x", "\t=1", "'=1", "''-1", "'", "'a", "", "a=1", "scene-1"])
def test_a_name_comes_back_and_is_no_formula(name):
    assert not cell_of(name).startswith(SIGNS)
    assert name_of(cell_of(name)) == name


def test_scene_and_camera_come_back_from_frames_csv(tmp_path):
    drive = MemoryDrive(2, make_rig({"=FRONT": 0.0}))
    with NativeWriter(tmp_path / "drive", with_ego_motion=True) as writer:
        for place in range(2):
            frame = drive.load(place)
            writer.write(replace(frame, stamp=replace(frame.stamp, scene="-1+1")))
    cells = [cell for row in csv.reader((tmp_path / "drive/frames.csv").open()) for cell in row]
    assert not any(cell.startswith(SIGNS) for cell in cells)
    again = open_sequence(tmp_path / "drive")
    assert again.rig.names == ("=FRONT",)
    assert {stamp.scene for stamp in again.stamps} == {"-1+1"}


def test_boxes_of_odd_names_are_no_formulas(tmp_path):
    boxes = boxes_ahead()
    boxes = replace(boxes, instances=boxes.classes.astype("<U20"))
    boxes.instances[:] = "@SUM(1)"
    frame = FrameBoxes(FrameStamp(0, "=1+1", 5), Pose.identity(), boxes)
    write_csv(BoxesFile("world", (frame,)), tmp_path / "boxes.csv")
    for row in csv.DictReader((tmp_path / "boxes.csv").open()):
        assert row["scene"] == "'=1+1"
        assert row["instance"] == "'@SUM(1)"
