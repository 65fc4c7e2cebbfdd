"""Models, formats, engines and commands by name: those of the core, of the workshop, and of other packages.

An installed package adds one by an entry point of a group (docs/extend.md). Nothing is imported before it is used.
"""

from functools import cache
from importlib import import_module, resources
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

from bevcli.errors import BevcliError, InputError
from bevcli.registered import Group

FLOORS = ("bevcli.registered", "bevcli.workshop.registered")


def own(group: Group) -> dict[str, str]:
    """The entries of a group that bevcli has: name -> "module:attribute"."""
    return {name: value for floor in FLOORS for name, value in import_module(floor).OWN.get(group, {}).items()}


@cache
def installed() -> Any:
    """The entry points of all installed packages, read once; Python 3.11 has another type for them than 3.12."""
    return entry_points()


@cache
def entries(group: Group) -> dict[str, EntryPoint]:
    """The entries of a group by name, in the order of their names. Raises BevcliError where two have the same name."""
    by_name = {name: EntryPoint(name, value, group) for name, value in own(group).items()}
    for entry in installed().select(group=group):
        if entry.value.startswith("bevcli."):  # of an earlier version, which an editable install may still list
            continue
        other = by_name.setdefault(entry.name, entry)
        if other.value != entry.value:
            raise BevcliError(
                f'entry point {group}: two packages register "{entry.name}": {other.value} and {entry.value}: '
                "uninstall one of them"
            )
    return dict(sorted(by_name.items()))


@cache
def load(group: Group, name: str) -> Any:
    """The object of an entry. Raises BevcliError for an unknown name, or for one that cannot be imported."""
    registered = entries(group)
    if name not in registered:
        raise BevcliError(f'entry point {group}: "{name}" is unknown (expected {", ".join(registered)})')
    try:
        return registered[name].load()
    except Exception as error:  # whatever a package of somebody else does
        raise BevcliError(
            f"entry point {group}: {name} = {registered[name].value} cannot be imported: {error}"
        ) from error


def load_form(group: Group, form: str) -> Any:
    """The format of files to write, as `load` gives it. form: its name, an option. Raises InputError."""
    if form not in entries(group):
        raise InputError(f"`form={form}`: unknown format (expected {', '.join(entries(group))})")
    return load(group, form)


def hub_of(name: str) -> str:
    """The hub that the name of a model begins with, such as "hf" of "hf:OWNER/NAME"; "" for another name."""
    hub, colon, _ = name.partition(":")
    return hub if colon and hub in entries("bevcli.hubs") else ""


def known_models() -> tuple[str, ...]:
    """The names of the models whose TOML files come with the package."""
    files = resources.files("bevcli").joinpath("configs").iterdir()
    return tuple(sorted(Path(file.name).stem for file in files if file.name.endswith(".toml")))
