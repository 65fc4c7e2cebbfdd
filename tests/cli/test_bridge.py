"""Commands made from dataclasses of options, and the options that select inputs, models and devices."""

import json
from pathlib import Path
from typing import Annotated, Literal

import pytest
import torch
import typer
from command_line import invoked
from typer.testing import CliRunner

from bevcli.cli.bridge import command
from bevcli.cli.main import PlainCommand, app
from bevcli.errors import BevcliError
from bevcli.inference.load import Model, choose_device
from bevcli.options import Option, named, option, options
from bevcli.sequences.open import open_sequence
from bevcli.sequences.options import InputOptions, parse_frames, parse_rate


def parse_range(text):
    try:
        start, stop = map(int, text.split(":"))
    except ValueError:
        raise ValueError(f'"{text}" (expected A:B)') from None
    return slice(start, stop)


@options("Input")
class ReadOptions:
    rate_hz: float | None = option(default=None, help="Frames per second.", flag="--rate", metavar="HZ", maximum=100)
    frames: slice | None = option(default=None, help="Frame range.", parse=parse_range)
    motion: Literal["required", "static"] = option(
        default="required", help="Stands.", flag="--static", flag_value="static"
    )
    calibration: str | Path | None = option(default=None, help="A file.")
    track: bool = option(default=True, help="Track.", flag="--track/--no-track")
    strict: bool = option(default=False, help="Strict.", panel="Checks")
    names: tuple[str, ...] = option(default=(), help="Names.", flag="--names -n", repeatable=True)
    secret: int = option(default=3, help="Only Python has it.", hidden=True)


def invoke(function, *arguments):
    app = typer.Typer(add_completion=False)
    app.command(cls=PlainCommand)(command(function))
    return CliRunner().invoke(app, arguments)


def test_options_arrive_as_the_dataclass_or_have_their_defaults():
    got = []

    def read(source: ReadOptions, force: Annotated[bool, Option("Overwrite.")] = False) -> None:
        got.append((source, force))

    given = ["--rate", "2", "--frames", "1:3", "--static", "--no-track", "--strict", "--names", "a", "-n", "b"]
    given += ["--calibration", "c.json", "--force"]
    assert (invoke(read, *given).exit_code, invoke(read).exit_code) == (0, 0)
    expected = ReadOptions(2.0, slice(1, 3), "static", Path("c.json"), False, True, ("a", "b"))
    assert got == [(expected, True), (ReadOptions(), False)]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--frames", "3"), "expected A:B"),
        (("--rate", "101"), "100"),
        (("--rate", "x"), "number"),
        (("--secret", "1"), ""),
    ],
)
def test_a_wrong_value_is_a_usage_error(arguments, message):
    def read(source: ReadOptions) -> None:
        raise AssertionError

    done = invoke(read, *arguments)
    assert done.exit_code == 2
    assert message in done.output
    assert arguments[0] in done.output


def test_the_docstring_of_a_class_has_the_help_texts():
    assert "\n    frames: Frame range.\n" in ReadOptions.__doc__


def test_a_text_names_an_option_as_both_spell_it():
    assert named(ReadOptions, "rate_hz") == "`rate_hz` (`--rate`)"
    assert named(ReadOptions, "track") == "`track` (`--track`)"
    assert named(ReadOptions, "names") == "`names` (`--names`)"


@pytest.mark.parametrize(
    ("text", "frames"), [("1:3", [1, 2]), (":2", [0, 1]), ("3:99", [3, 4]), ("4:", [4]), (":", [0, 1, 2, 3, 4])]
)
def test_frames_range_excludes_its_end(text, frames):
    assert [0, 1, 2, 3, 4][parse_frames(text)] == frames


@pytest.mark.parametrize("text", ["3", "a:b", "-1:2", "1:2:3", "", "٠:٢", "0:" + "9" * 5000])
def test_invalid_frames_range_is_a_usage_error(text):
    with pytest.raises(ValueError, match="expected A:B"):
        parse_frames(text)


def test_rate_is_a_number_or_all():
    assert parse_rate("2.5") == 2.5
    assert parse_rate("all") == "all"


@pytest.mark.parametrize("text", ["fast", "-2", "0", "inf", "nan"])
def test_invalid_rate_is_a_usage_error(text):
    with pytest.raises(ValueError, match="frames per second"):
        parse_rate(text)


def test_static_takes_precedence_over_no_temporal(mini_model):
    model = Model(mini_model)
    static = InputOptions(ego_motion="static")
    assert static.for_model(model.config, temporal=False).ego_motion == "static"
    assert InputOptions().for_model(model.config, temporal=False).ego_motion == "optional"
    assert InputOptions().for_model(model.config).ego_motion == "required"


def test_a_shell_is_given_the_names_that_start_with_the_text():
    words = {"_BEVCLI_COMPLETE": "complete_bash", "COMP_WORDS": "bevcli run x --model ti", "COMP_CWORD": "4"}
    assert CliRunner().invoke(app, [], prog_name="bevcli", env=words).output.split() == ["tiny", "tiny-fp16"]


@pytest.mark.parametrize("name", ["cuda:", "gpu", "cuda:x"])
def test_an_unknown_device_is_an_error(name):
    with pytest.raises(BevcliError, match=rf"`device={name}` \(`--device`\): unknown device"):
        choose_device(name)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_numbered_gpu_that_is_not_there_is_an_error():
    with pytest.raises(BevcliError, match=r"`device=cuda:1` \(`--device`\): PyTorch sees no CUDA GPU here"):
        choose_device("cuda:1")


def test_the_sample_drive_is_copied_once(tmp_path):
    for words in ("copied", "exists already"):
        assert words in invoked("samples", "--out", tmp_path / "samples").output
    assert len(open_sequence(tmp_path / "samples/street").stamps) == 20
    assert json.loads((tmp_path / "samples/first_steps.ipynb").read_text())["cells"]
