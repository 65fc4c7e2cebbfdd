"""BoxFormat: a format that boxes are exported in, registered under `bevcli.box_formats`; boxes files and CSV tables."""

import csv
import io
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from bevcli.evaluation import ExportOptions
from bevcli.geometry.boxes import NUMBERS, OPTIONAL_COLUMNS, TABLE_COLUMNS
from bevcli.parsing.documents import cell_of
from bevcli.printing import counted
from bevcli.sequences.files.boxes_file import BoxesFile, FrameBoxes, boxes_to_json, write_boxes
from bevcli.sequences.files.incremental_json import GrowingFile
from bevcli.writing import whole_file

COLUMNS = ("frame", "scene", "timestamp_ns", "frame_of_reference", *TABLE_COLUMNS)
NAMES = ("scene", "class", *(column.key for column in OPTIONAL_COLUMNS.values() if column.values == "text"))


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


class CsvWriter(GrowingFile):
    """`with CsvWriter(path) as writer: writer.write(frame, "world")`; the file is complete after every frame.

    Metres and radians; a cell is empty where a value is unknown. Raises OutputError where the file cannot be written.
    """

    def __init__(self, path: Path, resume_at: int | None = None, *, name: Path | None = None) -> None:
        """resume_at: `size` of an earlier writer of this file, to go on from there. name: for errors."""
        super().__init__(path, resume_at, name)
        if resume_at is None:
            self.append((",".join(COLUMNS) + "\n").encode())

    def write(self, frame: FrameBoxes, frame_of_reference: str) -> int:
        """Adds a row for each box of a frame, and returns their number."""
        text, stamp = io.StringIO(), frame.stamp
        table = csv.DictWriter(text, COLUMNS, lineterminator="\n")
        boxes = boxes_to_json(replace(frame.boxes, futures=None))  # a cell has one number
        for box in boxes:
            center, size, velocity = box.pop("center"), box.pop("size_lwh"), box.pop("velocity")
            row = {
                "frame": stamp.index,
                "scene": stamp.scene,
                "timestamp_ns": stamp.timestamp_ns,
                "frame_of_reference": frame_of_reference,
                **box,
                **dict(zip(NUMBERS, (*center, *size, box["yaw"], *velocity), strict=True)),
            }
            table.writerow(row | {name: cell_of(row[name]) for name in NAMES if row.get(name)})
        self.append(text.getvalue().encode())
        return len(boxes)


def write_csv(boxes: BoxesFile, path: Path) -> int:
    """Write all boxes in their frame of reference; return their number. Raises OutputError."""
    with whole_file(path) as unfinished, CsvWriter(unfinished, name=path) as writer:
        return sum(writer.write(frame, boxes.frame_of_reference) for frame in boxes.frames)


CSV = BoxFormat("boxes.csv", lambda boxes, target, *_: counted(write_csv(boxes, target), "boxes"))
JSON = BoxFormat("boxes.json", lambda boxes, target, *_: counted(write_boxes(boxes, target), "boxes"))
