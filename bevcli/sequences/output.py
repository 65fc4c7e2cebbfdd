"""OutputFormat: a format that drives are written in, found through the entry points `bevcli.drive_writers`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Protocol, Self

from bevcli.errors import InputError
from bevcli.registry import entries, load
from bevcli.sequences.options import WriteOptions

if TYPE_CHECKING:
    from bevcli.frame import Frame, Sequence

GROUP = "bevcli.drive_writers"


class DriveWriter(Protocol):
    """Writes a drive frame by frame: `with writer: writer.write(frame)`. What it writes is valid after the block only.

    After an error in the block, nothing under the final name opens as a drive.
    """

    def write(self, frame: Frame) -> None:
        """Write a frame and its images. Raises InputError for one that the format cannot hold, and OutputError."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *error: object) -> None: ...


@dataclass(frozen=True)
class OutputFormat:
    """A format that drives are written in.

    Attributes:
        name: with an article, for messages: "a nuScenes root".
        opener: makes the writer of a path for a sequence, or the name of what does, "module:attribute", which is
            imported when it is needed. Raises OutputError, and InputError for a drive that the format cannot hold.
        takes_boxes: the option `boxes` is for this format.
        keeps_maps: maps and lines of the ground truth are written; otherwise they are left out.
    """

    name: str
    opener: str | Callable[[Path, Sequence, WriteOptions], DriveWriter]
    takes_boxes: bool = False
    keeps_maps: bool = False

    def left_out(self, frame: Frame) -> set[str]:
        """What the format cannot hold of a frame, in words."""
        maps = {"maps": frame.ground_truth_map, "lines of the map": frame.ground_truth_lines}
        return set() if self.keeps_maps else {name for name, value in maps.items() if value is not None}


def open_writer(path: Path, sequence: Sequence, options: WriteOptions) -> DriveWriter:
    """The writer of a path in the format `options.form`.

    Raises InputError for an unknown format, an option of another format or a drive that the format cannot hold, and
    OutputError where the path cannot be written.
    """
    if options.form not in entries(GROUP):
        raise InputError(f"`form={options.form}`: unknown format (expected {', '.join(entries(GROUP))})")
    chosen: OutputFormat = load(GROUP, options.form)
    if options.boxes is not None and not chosen.takes_boxes:
        raise InputError(f"`boxes`: {chosen.name} takes no boxes of a run: remove the option")
    opener = resolve_name(chosen.opener) if isinstance(chosen.opener, str) else chosen.opener
    return opener(path, sequence, options)
