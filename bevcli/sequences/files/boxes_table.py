"""Tables of boxes: a CSV file with a row for each box."""

import csv
import io
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from bevcli.frame import FrameStamp
from bevcli.geometry.boxes import NUMBERS, OPTIONAL_COLUMNS, TABLE_COLUMNS, Boxes2D
from bevcli.printing import cell_of
from bevcli.sequences.files.boxes_file import BoxesFile, FrameBoxes, boxes_to_json
from bevcli.sequences.files.incremental_json import GrowingFile
from bevcli.writing import whole_file

IMAGE_COLUMNS = ("frame", "scene", "timestamp_ns", "camera", "class", "score", "x0", "y0", "x1", "y1")
COLUMNS = ("frame", "scene", "timestamp_ns", "frame_of_reference", *TABLE_COLUMNS)
NAMES = ("scene", "class", *(column.key for column in OPTIONAL_COLUMNS.values() if column.values == "text"))


class CsvWriter(GrowingFile):
    """`with CsvWriter(path) as writer: writer.write(frame, "world")`; the file is complete after every frame.

    Metres and radians; a cell is empty where a value is unknown. Raises OutputError where the file cannot be written.
    """

    def __init__(self, path: Path, resume_at: int | None = None) -> None:
        """resume_at: `size` of an earlier writer of this file, to go on from there."""
        super().__init__(path, resume_at)
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


class ImageBoxesWriter(GrowingFile):
    """As `CsvWriter`, for boxes in the images: a row for each box. Edges are pixels of the camera's image."""

    def __init__(self, path: Path, resume_at: int | None = None) -> None:
        super().__init__(path, resume_at)
        if resume_at is None:
            self.append((",".join(IMAGE_COLUMNS) + "\n").encode())

    def write(self, stamp: FrameStamp, boxes: Mapping[str, Boxes2D]) -> None:
        """Adds the rows of a frame. boxes: by camera."""
        text = io.StringIO()
        table = csv.writer(text, lineterminator="\n")
        for camera, in_image in boxes.items():
            for box in in_image:
                first = stamp.index, cell_of(stamp.scene), stamp.timestamp_ns, cell_of(camera), box.class_name
                table.writerow((*first, round(box.score, 4), *box.corners.round(1).tolist()))
        self.append(text.getvalue().encode())


def write_csv(boxes: BoxesFile, path: Path) -> int:
    """Write all boxes in their frame of reference; return their number. Raises OutputError."""
    with whole_file(path) as unfinished, CsvWriter(unfinished) as writer:
        return sum(writer.write(frame, boxes.frame_of_reference) for frame in boxes.frames)
