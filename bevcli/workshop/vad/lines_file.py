"""map_lines.json ("bevcli-map-lines/1"): lines of the map by frame."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from bevcli.errors import InputError
from bevcli.frame import FrameStamp, Ground, MapLines
from bevcli.sequences.files.incremental_json import FileOfFrames, read_frames, stamp_from_json, stamp_to_json
from bevcli.sequences.files.json_fields import array_of_numbers

FORMAT = "bevcli-map-lines/1"
TRUE_LINES = "ground_truth_lines.json"  # of a drive
DECIMALS = 3  # millimetres
_FRAMES_OF_REFERENCE = ("world", "ego")


@dataclass(frozen=True)
class FrameLines:
    """The lines of one frame, in the frame of reference of its file."""

    stamp: FrameStamp
    lines: MapLines


@dataclass(frozen=True)
class LinesFile:
    """All frames of a file, in its order.

    Attributes:
        frame_of_reference: "world" or "ego"; all points are in it.
        classes: that the lines may have.
        frames: the frames.
        extras: further members of the file's JSON object, such as "model".
    """

    frame_of_reference: str
    classes: tuple[str, ...]
    frames: tuple[FrameLines, ...]
    extras: Mapping[str, Any] = field(default_factory=dict)


class LinesWriter(FileOfFrames):
    """Writes map_lines.json frame by frame, as `BoxesWriter` writes boxes. Raises OutputError."""

    file_name = "map_lines.json"

    def __init__(
        self, path: Path, frame_of_reference: str, extras: Mapping[str, Any], resume_at: int | None = None
    ) -> None:
        """extras: at least "classes". resume_at: `size` of an earlier writer of this file, to go on from there."""
        head = {"format": FORMAT, "frame_of_reference": frame_of_reference, **extras}
        super().__init__(path, head, resume_at)

    def write(self, ground: Ground, lines: MapLines | None) -> None:
        """Append a frame. lines: in the bev frame; None where the model was not run."""
        found = [] if lines is None else [_line(ground, lines, place) for place in range(len(lines))]
        self.add({**stamp_to_json(ground.stamp), "lines": found}, f"frame {ground.stamp.index}")


def _line(ground: Ground, lines: MapLines, place: int) -> dict[str, Any]:
    score = {} if lines.scores is None else {"score": float(lines.scores[place])}
    points = ground.points(lines.points[place]).round(DECIMALS)
    return {"class": str(lines.classes[place]), **score, "points": points.tolist()}


def read_lines(path: Path) -> LinesFile:
    """Read map_lines.json. Of a writer that was killed, the partial file is read.

    Raises InputError, which names the frame and the line, where the file is missing or wrong.
    """
    content = read_frames(path, FORMAT, "a file of map lines", _FRAMES_OF_REFERENCE)
    reference, classes, rows = (content.pop(key, None) for key in ("frame_of_reference", "classes", "frames"))
    if not isinstance(classes, list) or not all(isinstance(name, str) for name in classes):
        raise InputError(f'{path}: "classes" must be a list of names, found {classes!r:.40}')
    frames = tuple(_frame(f"{path}: entry {place} of frames", row) for place, row in enumerate(rows))
    content.pop("format")
    return LinesFile(reference, tuple(classes), frames, content)


def _frame(where: str, row: Any) -> FrameLines:
    stamp, lines = stamp_from_json(row, where), row.get("lines")
    if not isinstance(lines, list):
        raise InputError(f'{where}: expected a list "lines", found {lines!r:.60}')
    for place, line in enumerate(lines):
        if not isinstance(line, dict) or not isinstance(line.get("class"), str):
            raise InputError(f'{where}: line {place}: expected an object with "class" and "points", found {line!r:.60}')
    points = tuple(_points(line.get("points"), f"{where}: line {place}") for place, line in enumerate(lines))
    classes = np.array([line["class"] for line in lines], dtype=np.str_)
    scores = None
    if any("score" in line for line in lines):
        scores = np.array([_score(line.get("score"), f"{where}: line {place}") for place, line in enumerate(lines)])
    return FrameLines(stamp, MapLines(points, classes, scores))


def _points(values: Any, where: str) -> np.ndarray:
    points = array_of_numbers(values)
    if points is None or points.ndim != 2 or points.shape[1] != 3 or len(points) < 2:
        raise InputError(f"{where}: points: expected at least two points of x, y, z, found {values!r:.60}")
    if not np.isfinite(points).all():
        raise InputError(f"{where}: points: expected finite numbers, found {values!r:.60}")
    return points


def _score(value: Any, where: str) -> float:
    if type(value) not in (int, float) or not 0 <= value <= 1:
        raise InputError(f"{where}: score: expected a number from 0 to 1, found {value!r:.40}")
    return float(value)
