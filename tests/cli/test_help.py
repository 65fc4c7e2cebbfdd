"""Help pages, and the words of the command line: a flag means the same in every command."""

import subprocess
import sys

import pytest
import typer
from command_line import command
from typer.testing import CliRunner

from bevcli.cli import main
from bevcli.cli.main import app
from bevcli.registry import entries

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
