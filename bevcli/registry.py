"""Models, formats, engines and commands, found through entry points; our own are registered in pyproject.toml too.

An installed package adds one by an entry point of a group below (docs/extend.md). Nothing is imported before it is
used.
"""

from functools import cache
from importlib import resources
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, Literal

from bevcli.errors import BevcliError, InputError

Group = Literal[
    "bevcli.models",
    "bevcli.sequences",
    "bevcli.label_formats",
    "bevcli.drive_writers",
    "bevcli.box_formats",
    "bevcli.engines",
    "bevcli.commands",
]


@cache
def entries(group: Group) -> dict[str, EntryPoint]:
    """The entry points of a group by name, in the order of their names.

    Raises BevcliError where two packages register the same name, or where bevcli's own are missing.
    """
    found: dict[str, EntryPoint] = {}
    for entry in sorted(entry_points(group=group), key=lambda entry: entry.name):
        other = found.setdefault(entry.name, entry)
        if other.value != entry.value:
            raise BevcliError(
                f'entry point {group}: two packages register "{entry.name}": {other.value} and {entry.value}: '
                "uninstall one of them"
            )
    if not found:
        raise BevcliError(f"entry point {group}: none is installed: install bevcli again (pip install bevcli)")
    return found


@cache
def load(group: Group, name: str) -> Any:
    """The object of an entry point. Raises BevcliError for an unknown name, or for one that cannot be imported."""
    known = entries(group)
    if name not in known:
        raise BevcliError(f'entry point {group}: "{name}" is unknown (expected {", ".join(known)})')
    try:
        return known[name].load()
    except Exception as error:  # whatever a package of somebody else does
        raise BevcliError(f"entry point {group}: {name} = {known[name].value} cannot be imported: {error}") from error


def load_form(group: Group, form: str) -> Any:
    """The format of files to write, as `load` gives it. form: its name, an option. Raises InputError."""
    if form not in entries(group):
        raise InputError(f"`form={form}`: unknown format (expected {', '.join(entries(group))})")
    return load(group, form)


def known_models() -> tuple[str, ...]:
    """The names of the models whose TOML files come with the package."""
    files = resources.files("bevcli").joinpath("configs").iterdir()
    return tuple(sorted(Path(file.name).stem for file in files if file.name.endswith(".toml")))
