"""Boxes as a CSV table with one row a box."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bevcli.errors import OutputError
from bevcli.sequences.files.box_json import boxes_to_json
from bevcli.sequences.files.boxes_file import BoxesFile, FrameBoxes

COLUMNS = (
    "frame", "scene", "timestamp_ns", "frame_of_reference", "class", "score", "x", "y", "z", "length", "width",
    "height", "yaw", "vx", "vy", "attribute", "instance", "visibility", "num_points",
)  # fmt: skip


def write_csv(boxes: BoxesFile, path: Path) -> int:
    """Write all boxes in their frame of reference, in metres and radians; a cell is empty where a value is unknown.

    Returns the number of boxes. Raises OutputError.
    """
    count = 0
    try:
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
            writer.writeheader()
            for frame in boxes.frames:
                for row in _rows(frame, boxes.frame_of_reference):
                    writer.writerow(row)
                    count += 1
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror})") from None
    return count


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
