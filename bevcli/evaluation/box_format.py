"""BoxFormat: a format of another tool that boxes are exported in, found through `bevcli.box_formats`."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from bevcli.evaluation.options import ExportOptions
from bevcli.sequences.files.boxes_file import BoxesFile


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
