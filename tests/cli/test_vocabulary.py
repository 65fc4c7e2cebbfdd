"""One vocabulary in all commands: a flag means the same everywhere."""

import pytest
import typer
from command_line import command

from bevcli.cli.main import app


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
