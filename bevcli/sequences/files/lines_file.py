"""map_lines.json ("bevcli-map-lines/1"): lines of the map by frame."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from bevcli.errors import InputError
from bevcli.frame import FrameStamp, Ground, MapLines
from bevcli.sequences.files.incremental_json import IncrementalJson, read_entries

FORMAT = "bevcli-map-lines/1"
TRUE_LINES = "ground_truth_lines.json"  # of a drive
LARGEST_BYTES = 4 << 30
DECIMALS = 3  # millimetres
_TAIL = "]}"
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


class LinesWriter:
    """Writes map_lines.json frame by frame, as `BoxesWriter` writes boxes. Raises OutputError."""

    name = "map_lines.json"

    def __init__(
        self, path: Path, frame_of_reference: str, extras: Mapping[str, Any], resume_at: int | None = None
    ) -> None:
        """extras: at least "classes". resume_at: `file.size` of an earlier writer of this file, to go on from there."""
        head = {"format": FORMAT, "frame_of_reference": frame_of_reference, **extras}
        self.file = IncrementalJson(path, json.dumps(head)[:-1] + ', "frames": [', _TAIL, resume_at)

    def write(self, ground: Ground, lines: MapLines | None) -> None:
        """Append a frame. lines: in the bev frame; None where the model was not run."""
        stamp = ground.stamp
        found: list[dict[str, Any]] = []
        for place, points in enumerate(() if lines is None else lines.points):
            assert lines is not None
            line: dict[str, Any] = {"class": str(lines.classes[place])}
            if lines.scores is not None:
                line["score"] = float(lines.scores[place])
            found.append(line | {"points": ground.points(points).round(DECIMALS).tolist()})
        row = {"frame": stamp.index, "scene": stamp.scene, "timestamp_ns": stamp.timestamp_ns, "lines": found}
        self.file.append(row, f"frame {stamp.index}")

    def close(self) -> None:
        """Complete the file."""
        self.file.close()


def read_lines(path: Path) -> LinesFile:
    """Read map_lines.json. Of a writer that was killed, the partial file is read.

    Raises InputError, which names the frame and the line, where the file is missing or wrong.
    """
    missing = f'the file is missing (expected lines of the map, "format": "{FORMAT}")'
    content = read_entries(path, _TAIL, LARGEST_BYTES, missing=missing)
    found = content.get("format") if isinstance(content, dict) else type(content).__name__
    if found != FORMAT:
        raise InputError(f'{path}: is not a file of map lines: "format" must be "{FORMAT}", found {found!r:.40}')
    reference, classes, rows = (content.pop(key, None) for key in ("frame_of_reference", "classes", "frames"))
    if reference not in _FRAMES_OF_REFERENCE:
        raise InputError(f'{path}: "frame_of_reference" must be world or ego, found {reference!r:.40}')
    if not isinstance(classes, list) or not all(isinstance(name, str) for name in classes):
        raise InputError(f'{path}: "classes" must be a list of names, found {classes!r:.40}')
    if not isinstance(rows, list):
        raise InputError(f'{path}: "frames" is missing or not a list (expected one object per frame)')
    frames = tuple(_frame(f"{path}: entry {place} of frames", row) for place, row in enumerate(rows))
    content.pop("format")
    return LinesFile(reference, tuple(classes), frames, content)


def _frame(where: str, row: Any) -> FrameLines:
    if not isinstance(row, dict) or type(row.get("frame")) is not int or type(row.get("timestamp_ns")) is not int:
        raise InputError(f'{where}: expected an object with the integers "frame" and "timestamp_ns", found {row!r:.60}')
    scene, lines = row.get("scene", ""), row.get("lines")
    if not isinstance(scene, str) or not isinstance(lines, list):
        raise InputError(f'{where}: expected a text "scene" and a list "lines", found {row!r:.60}')
    for place, line in enumerate(lines):
        if not isinstance(line, dict) or not isinstance(line.get("class"), str):
            raise InputError(f'{where}: line {place}: expected an object with "class" and "points", found {line!r:.60}')
    points = tuple(_points(line.get("points"), f"{where}: line {place}") for place, line in enumerate(lines))
    classes = np.array([line["class"] for line in lines], dtype=np.str_)
    scores = None
    if any("score" in line for line in lines):
        scores = np.array([_score(line.get("score"), f"{where}: line {place}") for place, line in enumerate(lines)])
    return FrameLines(FrameStamp(row["frame"], scene, row["timestamp_ns"]), MapLines(points, classes, scores))


def _points(values: Any, where: str) -> np.ndarray:
    try:
        points = np.asarray(values)
    except ValueError:  # ragged lists
        points = np.zeros(0)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < 2 or points.dtype.kind not in "iuf":
        raise InputError(f"{where}: points: expected at least two points of x, y, z, found {values!r:.60}")
    if not np.isfinite(points).all():
        raise InputError(f"{where}: points: expected finite numbers, found {values!r:.60}")
    return points.astype(np.float64)


def _score(value: Any, where: str) -> float:
    if type(value) not in (int, float) or not 0 <= value <= 1:
        raise InputError(f"{where}: score: expected a number from 0 to 1, found {value!r:.40}")
    return float(value)
