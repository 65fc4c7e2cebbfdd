"""Help pages and commands made from dataclasses of options: a flag means the same in every command."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Annotated, Literal

import pytest
import torch
import typer
from command_line import command, invoked
from typer.testing import CliRunner

from bevcli.cli import bridge, main
from bevcli.cli.main import PlainCommand, app
from bevcli.errors import BevcliError
from bevcli.inference.load import Model, choose_device
from bevcli.options import Option, named, option, options
from bevcli.registry import entries
from bevcli.sequences.open import open_sequence
from bevcli.sequences.options import InputOptions, parse_frames, parse_rate

COMMANDS = [name for name in entries("bevcli.commands") if name != "weights"] + ["weights inspect", "weights convert"]


def help_of(*arguments: str) -> str:
    result = CliRunner(env={"COLUMNS": "80", "TERMINAL_WIDTH": "80"}).invoke(main.app, [*arguments, "--help"])
    assert result.exit_code == 0, result.output
    return result.output


def test_help_of_the_program_groups_all_commands_unbuilt(monkeypatch):
    monkeypatch.setattr(main, "command", lambda *_: pytest.fail("a command was built"))
    text = help_of()
    places = [text.index(f"\n{panel}:\n") for panel in ("Start", "Run", "Look", "Score", "Train", "Deploy")]
    assert places == sorted(places)
    assert "Other commands" not in text
    for name in entries("bevcli.commands"):
        assert f"\n  {name} " in text


@pytest.mark.parametrize("name", COMMANDS)
def test_help_of_a_command_fits_80_columns(name):
    text = help_of(*name.split())
    assert max(map(len, text.splitlines())) <= 80
    assert "<" not in text.replace("<=", "")  # typer's names of types
    assert "bool" not in text
    assert "\\" not in text


def test_options_stand_under_their_panels():
    text = help_of("run")
    assert text.index("\nInput:\n") < text.index("  --rate HZ|all")
    assert text.index("\nOptions:\n") < text.index("  -h, --help")


def test_help_of_a_command_imports_no_other_wing():
    """Beside the options of the input formats."""
    code = (
        "import contextlib, io, sys\n"
        "from bevcli.cli.main import app\n"
        "for name in ('viz', 'run', 'bench'):\n"
        "    with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):\n"
        "        app([name, '--help'], standalone_mode=False)\n"
        "    wings = {part[2] for part in (module.split('.') for module in sys.modules) if part[1:2] == ['workshop'] "
        "and len(part) > 2}\n"
        "    print(name, *sorted(wings - {'registered'}))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["viz formats", "run formats", "bench benchmark formats"]


def test_help_of_the_program_loads_nothing_heavy():
    heavy = ("torch", "numpy", "cv2", "rerun", "scipy", "numba", "msgspec")
    code = (
        "import sys\nfrom bevcli.cli.main import app\n"
        "try:\n    app(['--help'])\nexcept SystemExit:\n    pass\n"
        f"print([module for module in {heavy} if module in sys.modules], file=sys.stderr)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.strip() == "[]"


def commands(found, name=""):
    """All commands by name."""
    if not hasattr(found, "commands"):
        return {name.strip(): found}
    parts = [commands(found.get_command(None, part), f"{name} {part}") for part in found.list_commands(None)]
    return {key: each for part in parts for key, each in part.items()}


def test_a_flag_means_the_same_in_all_commands():
    found = commands(typer.main.get_command(app))
    shown = [(name, each) for name, one in found.items() for each in one.params if not getattr(each, "hidden", False)]
    flags = [(name, flag, each.metavar) for name, each in shown for flag in each.opts]

    def with_flag(start):
        return {name for name, flag, _ in flags if flag.startswith(start)}

    assert {metavar for _, flag, metavar in flags if flag == "--frames"} == {"A:B"}
    assert {metavar for _, flag, metavar in flags if flag == "--count"} == {"N"}
    assert {name for name, flag, _ in flags if flag == "--out"} == {name for name, flag, _ in flags if flag == "-o"}
    assert with_flag("--calibrate") == {"run", "stress"}
    assert with_flag("--int8-drive") >= {"run", "batch", "validate", "quantize"}
    models = {name for name, each in shown if each.param_type_name == "argument" and each.name == "model"}
    assert models == {"quantize"}  # which converts a file


@pytest.mark.parametrize(
    ("arguments", "flag"), [(("train", "--rendered", "0:2"), "--model"), (("quantize", __file__), "--int8-drive")]
)
def test_a_command_asks_for_an_option_that_it_needs(arguments, flag, tmp_path):
    done = command(tmp_path, *arguments)
    assert done.returncode == 2
    assert f"{flag}: is missing" in done.stderr


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
    app.command(cls=PlainCommand)(bridge.command(function))
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
