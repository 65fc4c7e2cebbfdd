"""Boxes as a CSV table with one row a box."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

from bevcli.sequences.files.box_json import boxes_to_json
from bevcli.sequences.files.boxes_file import BoxesFile, FrameBoxes
from bevcli.sequences.files.growing_file import GrowingFile

COLUMNS = (
    "frame", "scene", "timestamp_ns", "frame_of_reference", "class", "score", "x", "y", "z", "length", "width",
    "height", "yaw", "vx", "vy", "attribute", "instance", "track_score", "duplicate", "visibility", "num_points",
)  # fmt: skip


class CsvWriter:
    """`with CsvWriter(path) as writer: writer.write(frame, "world")`; the file is complete after every frame.

    Metres and radians; a cell is empty where a value is unknown. Raises OutputError where the file cannot be written.
    """

    def __init__(self, path: Path, resume_at: int | None = None) -> None:
        """resume_at: `file.size` of an earlier writer of this file, to go on from there."""
        self.file = GrowingFile(path, resume_at)
        if resume_at is None:
            header = io.StringIO()
            csv.DictWriter(header, COLUMNS, lineterminator="\n").writeheader()
            self.file.append(header.getvalue().encode())

    def write(self, frame: FrameBoxes, frame_of_reference: str) -> int:
        """Adds a row for each box of a frame, and returns their number."""
        rows = list(_rows(frame, frame_of_reference))
        text = io.StringIO()
        csv.DictWriter(text, COLUMNS, lineterminator="\n").writerows(rows)
        self.file.append(text.getvalue().encode())
        return len(rows)

    def __enter__(self) -> CsvWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.file.close()


def write_csv(boxes: BoxesFile, path: Path) -> int:
    """Write all boxes in their frame of reference; return their number. Raises OutputError."""
    with CsvWriter(path) as writer:
        return sum(writer.write(frame, boxes.frame_of_reference) for frame in boxes.frames)


def _rows(frame: FrameBoxes, frame_of_reference: str) -> Iterator[dict[str, Any]]:
    stamp = frame.stamp
    for box in boxes_to_json(frame.boxes):
        center, size, velocity = box.pop("center"), box.pop("size_lwh"), box.pop("velocity")
        yield {
            "frame": stamp.index,
            "scene": stamp.scene,
            "timestamp_ns": stamp.timestamp_ns,
            "frame_of_reference": frame_of_reference,
            **box,
            **dict(zip(("x", "y", "z"), center, strict=True)),
            **dict(zip(("length", "width", "height"), size, strict=True)),
            **dict(zip(("vx", "vy"), velocity, strict=True)),
        }
