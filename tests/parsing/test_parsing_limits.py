"""JSON, TOML, YAML and CSV: well-formed texts that would break the code behind the parser are refused in one line."""

import os
import time

import pytest

from bevcli.errors import ConfigError, InputError
from bevcli.parsing.documents import parse_json, parse_toml, read_csv, read_json
from bevcli.parsing.files import read_bytes
from bevcli.workshop.formats.markup import read_yaml


def refused(function, *arguments, error=InputError, **options):
    """The message; it names the file and has one line."""
    began = time.monotonic()
    with pytest.raises(error) as caught:
        function(*arguments, **options)
    assert "\n" not in str(caught.value)
    assert "file" in str(caught.value)
    assert time.monotonic() - began < 5
    return str(caught.value)


@pytest.mark.parametrize("levels", [65, 1000, 100_000, 1_000_000])
@pytest.mark.parametrize(("start", "end"), [(b"[", b"]"), (b'{"a":', b"}")])
def test_deep_json_is_refused(levels, start, end):
    text = start * levels + b"1" + end * levels
    assert "nested too deeply" in refused(parse_json, text, "file")
    assert "nested too deeply" in refused(parse_json, start * levels, "file")


def test_brackets_in_a_text_are_no_nesting():
    text = b'{"a": "' + b"[" * 1000 + b'\\"[", "b": [' + b'"{", ' * 100 + b"1]}"
    assert parse_json(text, "file")["b"][-1] == 1


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


def test_half_a_character_is_refused():
    refused(parse_json, b'["\\ud800"]', "file")
    assert parse_json(b'["\\ud83d\\ude00"]', "file") == ["\N{GRINNING FACE}"]


@pytest.mark.parametrize(
    "text",
    [
        "[" * 100_000,
        "a: " * 10_000,
        "- " * 10_000,
        "a: &x [*x]",
        "x: &a [1]\n" + "".join(f"x{n}: &{chr(98 + n)} [{', '.join(['*' + chr(97 + n)] * 10)}]\n" for n in range(9)),
        "a: 2001-99-99",
        "a: !!python/object/apply:os.system [true]",
        "a: !!int x",
        "? {a: 1}\n: 2",
        "a: \x00",
    ],
    ids=range(10),
)
def test_odd_yaml_is_refused(tmp_path, text):
    path = tmp_path / "file.yaml"
    path.write_text(text)
    refused(read_yaml, path)


def test_an_alias_of_a_plain_list_is_read(tmp_path):
    path = tmp_path / "file.yaml"
    path.write_text("a: &x [1, 2]\nb: *x\n")
    assert read_yaml(path) == {"a": [1, 2], "b": [1, 2]}


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
    assert "at most 64 MiB" in refused(read_json, huge)
