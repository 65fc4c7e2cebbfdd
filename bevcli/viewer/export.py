"""The boxes of a recording as a file: a table (.csv) or boxes that `bevcli eval` reads (.json)."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path

from bevcli.errors import InputError, OutputError
from bevcli.sequences.files.boxes_file import BoxesWriter, FrameBoxes
from bevcli.viewer.recorded_boxes import RecordedBoxes, recorded_boxes
from bevcli.viewer.recording_reader import RecordingReader

COLUMNS = (
    "frame", "scene", "timestamp_ns", "class", "score", "x", "y", "z", "length", "width", "height", "yaw",
    "velocity_x", "velocity_y",
)  # fmt: skip


def export_boxes(recording: Path, path: Path) -> tuple[int, int]:
    """Writes the shown boxes, in the world frame, metres and radians; returns the number of frames and of boxes.

    Raises InputError for another ending than .csv or .json, OutputError where the file cannot be written.
    """
    writers = {".csv": _write_csv, ".json": _write_json}
    if path.suffix.lower() not in writers:
        raise InputError(f"--export {path}: the file must end in .csv or .json")
    frames = [recorded_boxes(frame) for frame in RecordingReader(recording).frames()]
    try:
        writers[path.suffix.lower()](path, frames)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror})") from error
    return len(frames), sum(len(frame.boxes) for frame in frames)


def _write_csv(path: Path, frames: list[RecordedBoxes]) -> None:
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        for frame in frames:
            writer.writerows(_rows(frame))


def _rows(frame: RecordedBoxes) -> Iterator[list[object]]:
    stamp, boxes = frame.stamp, frame.boxes
    scores = boxes.scores if boxes.scores is not None else [None] * len(boxes)
    for i, score in enumerate(scores):
        numbers = (*boxes.centers[i], *boxes.sizes_lwh[i], boxes.yaws[i], *boxes.velocities[i])
        rounded = [f"{number:.4f}" for number in numbers]
        yield [stamp.index, stamp.scene, stamp.timestamp_ns, boxes.classes[i], f"{score:.4f}", *rounded]


def _write_json(path: Path, frames: list[RecordedBoxes]) -> None:
    with BoxesWriter(path, "world") as writer:
        for frame in frames:
            writer.write(FrameBoxes(frame.stamp, frame.world_from_ego, frame.boxes))
