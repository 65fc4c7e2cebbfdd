"""BoxFormat: a format of another tool that boxes are exported in, found through `bevcli.box_formats`."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from bevcli.errors import InputError
from bevcli.evaluation.options import ExportOptions
from bevcli.registry import entries, load
from bevcli.sequences.files.boxes_file import BoxesFile

GROUP = "bevcli.box_formats"


@dataclass(frozen=True)
class BoxFormat:
    """A format that boxes are exported in.

    Attributes:
        target: name of the file or folder that is written next to the boxes by default.
        write: writes boxes to a path with the options of the export, given the file that the boxes are from, and
            returns what it wrote, such as "20 frames, 3 tracks". Raises InputError for boxes that the format cannot
            hold, and OutputError.
    """

    target: str
    write: Callable[[BoxesFile, Path, ExportOptions, Path], str]


def box_format(name: str) -> BoxFormat:
    """The format of a name. Raises InputError for an unknown one."""
    if name not in entries(GROUP):
        raise InputError(f"`form={name}`: unknown format (expected {', '.join(entries(GROUP))})")
    found: BoxFormat = load(GROUP, name)
    return found
