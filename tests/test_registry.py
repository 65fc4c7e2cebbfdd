"""The registry: bevcli's own entries need no installation, and a fault of another package's is one clear line."""

import re
import tomllib
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from typing import get_args

import pytest
from typer.testing import CliRunner

from bevcli import registry
from bevcli.cli.main import app
from bevcli.errors import BevcliError
from bevcli.registry import OWN, Group

GROUP = "bevcli.sequences"


@pytest.fixture
def installed(monkeypatch):
    """Makes the given (name, object) the entry points of a group."""

    def install(*entries, group=GROUP):
        found = [EntryPoint(name, value, group) for name, value in entries]
        monkeypatch.setattr(registry, "installed", lambda: EntryPoints(found))
        registry.entries.cache_clear()
        registry.load.cache_clear()

    yield install
    monkeypatch.undo()
    registry.entries.cache_clear()
    registry.load.cache_clear()


@pytest.mark.parametrize("group", get_args(Group))
def test_own_entries_need_no_metadata_of_an_installation(group, installed):
    installed()
    assert list(registry.entries(group)) == sorted(OWN[group])
    assert all(registry.load(group, name) is not None for name in OWN[group])


def test_bevcli_states_no_entry_points_of_its_own():
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
    assert "entry-points" not in project


def test_a_new_format_of_bevcli_works_at_once(installed, monkeypatch):
    installed()
    monkeypatch.setitem(OWN[GROUP], "new", "json:loads")
    assert registry.load(GROUP, "new")("[1]") == [1]


def test_metadata_of_an_earlier_version_of_bevcli_are_ignored(installed):
    installed(("native", "bevcli.native:FORMAT"), ("gone", "bevcli.sequences.gone:FORMAT"))
    assert list(registry.entries(GROUP)) == sorted(OWN[GROUP])
    assert registry.load(GROUP, "native").expected


def test_an_unknown_name_is_named_with_those_that_exist():
    with pytest.raises(BevcliError, match=r'"lidar" is unknown .expected .*, native, nuscenes, ros, '):
        registry.load(GROUP, "lidar")


def test_an_entry_that_cannot_be_imported_is_named(installed):
    installed(("good", "json:loads"), ("bad", "a_package_that_is_missing:FORMAT"))
    assert registry.load(GROUP, "good")("[1]") == [1]
    with pytest.raises(BevcliError, match=r"bad = a_package_that_is_missing:FORMAT cannot be imported"):
        registry.load(GROUP, "bad")


def test_two_packages_with_the_same_name_are_refused(installed):
    installed(("one", "json:loads"), ("one", "json:dumps"))
    with pytest.raises(BevcliError, match='two packages register "one"'):
        registry.entries(GROUP)
    installed(("one", "json:loads"), ("one", "json:loads"))
    assert list(registry.entries(GROUP)) == sorted([*OWN[GROUP], "one"])


def test_a_package_cannot_replace_a_format_of_bevcli(installed):
    installed(("ros", "json:loads"))
    with pytest.raises(BevcliError, match=r'two packages register "ros": bevcli.workshop.formats:BagOptions and json:'):
        registry.entries(GROUP)


def test_a_broken_command_of_a_package_costs_a_warning(installed):
    installed(("broken", "a_package_that_is_missing:run"), group="bevcli.commands")
    shown = CliRunner().invoke(app, ["--help"])
    assert shown.exit_code == 0
    assert "  export " in shown.stdout
    assert "  broken " not in shown.stdout
    (warning,) = shown.stderr.splitlines()
    assert re.match("warning: .*broken = a_package_that_is_missing:run cannot be imported: ", warning)
    assert CliRunner().invoke(app, ["export", "--help"]).exit_code == 0
    with pytest.raises(BevcliError, match="a_package_that_is_missing:run cannot be imported"):
        CliRunner().invoke(app, ["broken"], catch_exceptions=False)
