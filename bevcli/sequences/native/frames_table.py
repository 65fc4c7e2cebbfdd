"""frames.csv: one row per frame, with its time and the location of each camera's image."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from bevcli.errors import InputError
from bevcli.frame import FrameStamp
from bevcli.sequences.images import ImageSource, Source
from bevcli.sequences.native.csv_table import CsvRow, CsvTable, read_csv

VIDEO_CELL = re.compile(r"(?P<path>.+)#(?P<index>\d+)")
NO_IMAGE = "no image in frames.csv"


@dataclass(frozen=True)
class FrameEntry:
    """One frame before its images are read. Each camera is in `sources` or in `dropped`.

    Attributes:
        stamp: index, scene and time of the frame.
        sources: location of the image, by camera.
        dropped: reason why there is no image, by camera.
        origin: where the frame is listed, such as "frames.csv: line 3", for error messages.
    """

    stamp: FrameStamp
    sources: Mapping[str, Source]
    dropped: Mapping[str, str]
    origin: str


def read_frames_table(path: Path, cameras: Sequence[str]) -> tuple[FrameEntry, ...]:
    """Read frames.csv. A camera's cell is a path relative to the table's folder, or `video#index`.

    Raises InputError for an invalid column or cell, a camera without a column, or times that do not increase in a
    scene.
    """
    table = _read_columns(path, cameras)
    entries = tuple(_entry(row, cameras, path.parent) for row in table.rows)
    _check_numbers(table.rows, entries)
    check_times(entries)
    return entries


def check_times(entries: Iterable[FrameEntry]) -> None:
    """Raise InputError unless times increase within each scene, a run of frames with the same scene name."""
    earlier: FrameEntry | None = None
    for entry in entries:
        stamp = entry.stamp
        if earlier and earlier.stamp.scene == stamp.scene and stamp.timestamp_ns <= earlier.stamp.timestamp_ns:
            raise InputError(
                f"{entry.origin}: timestamp_ns {stamp.timestamp_ns} is not later than the previous frame's "
                f"({earlier.stamp.timestamp_ns}): sort the frames by time, or give them different scenes"
            )
        earlier = entry


def _read_columns(path: Path, cameras: Sequence[str]) -> CsvTable:
    times = [f"{name}.timestamp_ns" for name in cameras]
    table = read_csv(path, ("frame", "timestamp_ns"), ("scene", *cameras, *times))
    for name in cameras:
        if name not in table.columns:
            raise InputError(
                f"{path}: camera {name}: its column is missing (expected, because the calibration has the camera): "
                f'add a column "{name}" (cells may be empty), or remove the camera from the calibration'
            )
    return table


def _entry(row: CsvRow, cameras: Sequence[str], folder: Path) -> FrameEntry:
    stamp = FrameStamp(row.integer("frame"), row.cells.get("scene", ""), row.integer("timestamp_ns"))
    sources = {name: _source(row, name, folder, stamp.timestamp_ns) for name in cameras if row.cells[name]}
    dropped = {name: NO_IMAGE for name in cameras if not row.cells[name]}
    return FrameEntry(stamp, sources, dropped, f"{row.path}: line {row.line}")


def _source(row: CsvRow, camera: str, folder: Path, frame_ns: int) -> ImageSource:
    time_column = f"{camera}.timestamp_ns"
    timestamp_ns = row.integer(time_column) if row.cells.get(time_column) else frame_ns
    video = VIDEO_CELL.fullmatch(row.cells[camera])
    if video:
        return ImageSource(folder / video["path"], timestamp_ns, int(video["index"]))
    return ImageSource(folder / row.cells[camera], timestamp_ns)


def _check_numbers(rows: Sequence[CsvRow], entries: Sequence[FrameEntry]) -> None:
    seen: dict[int, int] = {}
    for row, entry in zip(rows, entries, strict=True):
        number = entry.stamp.index
        if number < 0 or number in seen:
            found = f"is also on line {seen[number]}" if number in seen else "is negative"
            raise row.error("frame", f"{number} {found} (expected a unique integer, 0 or more)")
        seen[number] = row.line
