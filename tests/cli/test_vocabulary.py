"""One vocabulary in all commands: a flag means the same everywhere."""

import pytest
import typer
from command_line import command

from bevcli.cli.main import app


def commands(found=None, name=""):
    """All commands by name."""
    found = typer.main.get_command(app) if found is None else found
    if not hasattr(found, "commands"):
        return {name.strip(): found}
    parts = [commands(found.get_command(None, part), f"{name} {part}") for part in found.list_commands(None)]
    return {key: each for part in parts for key, each in part.items()}


def shown(command):
    return [parameter for parameter in command.params if not getattr(parameter, "hidden", False)]


def test_frames_is_a_range_and_count_a_number():
    found = [(flag, each.metavar) for one in commands().values() for each in shown(one) for flag in each.opts]
    assert {metavar for flag, metavar in found if flag == "--frames"} == {"A:B"}
    assert {metavar for flag, metavar in found if flag == "--count"} == {"N"}


def test_every_out_has_a_short_form():
    options = {name: {flag for each in shown(found) for flag in each.opts} for name, found in commands().items()}
    assert all(("--out" in flags) == ("-o" in flags) for flags in options.values())
    assert sum("-o" in flags for flags in options.values()) > 8


def test_calibrate_means_the_cameras_and_int8_has_its_own_flag():
    found = [(name, flag) for name, one in commands().items() for each in shown(one) for flag in each.opts]
    assert {name for name, flag in found if flag.startswith("--calibrate")} == {"run", "stress"}
    assert {name for name, flag in found if flag == "--int8-drive"} >= {"run", "batch", "validate", "quantize"}


def test_no_command_takes_the_name_of_a_model_as_an_argument():
    for name, found in commands().items():
        arguments = [each.name for each in shown(found) if each.param_type_name == "argument"]
        assert name == "quantize" or "model" not in arguments  # which converts a file


@pytest.mark.parametrize(
    ("arguments", "flag"), [(("train", "--rendered", "0:2"), "--model"), (("quantize", __file__), "--int8-drive")]
)
def test_a_command_asks_for_an_option_that_it_needs(arguments, flag, tmp_path):
    done = command(tmp_path, *arguments)
    assert done.returncode == 2
    assert f"{flag}: is missing" in done.stderr
