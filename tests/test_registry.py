"""The registry: bevcli's own entries can be imported, and what is wrong with another package's is one clear line."""

from importlib.metadata import EntryPoint
from typing import get_args

import pytest

from bevcli import registry
from bevcli.errors import BevcliError

GROUP = "bevcli.sequences"


@pytest.fixture
def installed(monkeypatch):
    """Makes entry points of a group those of the given name -> object."""

    def install(*entries):
        found = [EntryPoint(name, value, GROUP) for name, value in entries]
        monkeypatch.setattr(registry, "entry_points", lambda group: found)
        registry.entries.cache_clear()
        registry.load.cache_clear()

    yield install
    monkeypatch.undo()
    registry.entries.cache_clear()
    registry.load.cache_clear()


@pytest.mark.parametrize("group", get_args(registry.Group))
def test_own_entries_are_found_in_the_order_of_names(group):
    names = list(registry.entries(group))
    assert names == sorted(names)
    assert names


def test_own_formats_can_be_imported():
    assert all(registry.load(GROUP, name).expected for name in registry.entries(GROUP))


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
    assert list(registry.entries(GROUP)) == ["one"]


def test_a_group_without_any_entry_says_what_to_do(installed):
    installed()
    with pytest.raises(BevcliError, match="install bevcli again"):
        registry.entries(GROUP)
