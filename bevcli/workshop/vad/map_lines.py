"""Lines of the map: what a model finds and what a drive has, map_lines.json ("bevcli-map-lines/1"), their drawing."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.frame import Frame, FrameResult, FrameStamp, Ground, GroundLines
from bevcli.geometry.object_classes import Color
from bevcli.geometry.transforms import Array, apply, inverse
from bevcli.recording.entities import map_colors
from bevcli.sequences.files.incremental_json import (
    IncrementalJson,
    read_frames,
    stamp_from_json,
    stamp_to_json,
)
from bevcli.sequences.files.json_fields import array_of_numbers

FORMAT = "bevcli-map-lines/1"
# The classes of the true lines of drives, which are those of the published VAD.
LINE_CLASSES = ("divider", "ped_crossing", "boundary")
TRUE_LINES = "ground_truth_lines.json"  # of a native sequence folder
DECIMALS = 3  # millimetres
_FRAMES_OF_REFERENCE = ("world", "ego")
# Bright, because lines of the map are thin.
LINE_COLORS: dict[str, Color] = {
    "divider": (250, 225, 120),
    "ped_crossing": (205, 140, 255),
    "boundary": (90, 225, 130),
}
OTHER_LINE_COLORS: tuple[Color, ...] = ((120, 170, 255), (255, 170, 120), (160, 235, 225), (235, 150, 205))
OPACITY, WIDTH = 230, 1.6  # of 255; points of the user interface


class LinesWriter(IncrementalJson):
    """Writes map_lines.json frame by frame, as `BoxesWriter` writes boxes. Raises OutputError."""

    def __init__(
        self, path: Path, frame_of_reference: str, extras: Mapping[str, Any], resume_at: int | None = None
    ) -> None:
        """extras: at least "classes". resume_at: `size` of an earlier writer of this file, to go on from there."""
        head = {"format": FORMAT, "frame_of_reference": frame_of_reference, **extras}
        super().__init__(path, head, "frames", resume_at)

    def write(self, ground: Ground, lines: "MapLines | None") -> None:
        """Append a frame. lines: in the bev frame; None where the model was not run."""
        entries = [] if lines is None else [_line(ground, lines, index) for index in range(len(lines))]
        self.add({**stamp_to_json(ground.stamp), "lines": entries}, f"frame {ground.stamp.index}")


def _line(ground: Ground, lines: "MapLines", index: int) -> dict[str, Any]:
    score = {} if lines.scores is None else {"score": float(lines.scores[index])}
    points = ground.points(lines.points[index]).round(DECIMALS)
    return {"class": str(lines.classes[index]), **score, "points": points.tolist()}


@dataclass(frozen=True)
class MapLines(FrameResult):
    """N lines of the map, such as lane dividers.

    Attributes:
        points: N lines of x and y in the bev frame (P, 2), or of points on the ground in the ego or world frame (P, 3),
            metres; P may differ.
        classes: (N,) class names.
        scores: (N,) confidence, 0 to 1. Optional.
    """

    kind = "map_lines"
    file_name = "map_lines.json"
    writer = LinesWriter
    true_file = TRUE_LINES
    true_names = LINE_CLASSES

    points: tuple[Array, ...]
    classes: NDArray[np.str_]
    scores: Array | None = None

    def __len__(self) -> int:
        return len(self.points)

    @classmethod
    def legend(cls, names: tuple[str, ...]) -> dict[str, Color]:
        return {f"line: {name.replace('_', ' ')}": color for name, color in line_colors(names).items()}

    def drawn(self, ground: Ground, names: tuple[str, ...], score: float) -> GroundLines:
        colors = line_colors(names)
        scores = np.ones(len(self)) if self.scores is None else self.scores
        shown = np.flatnonzero(scores >= score)
        strips = [ground.points(self.points[index]) for index in shown]
        return GroundLines(strips, [(*colors[str(self.classes[index])], OPACITY) for index in shown], WIDTH)


def line_colors(classes: tuple[str, ...]) -> dict[str, Color]:
    """Class of lines -> colour, in the order of the classes."""
    return map_colors(classes, LINE_COLORS, OTHER_LINE_COLORS)


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


def read_lines(path: Path) -> LinesFile:
    """Read map_lines.json. Of a writer that was killed, the partial file is read.

    Raises InputError, which names the frame and the line, where the file is missing or wrong.
    """
    content = read_frames(path, FORMAT, "a file of map lines", _FRAMES_OF_REFERENCE)
    reference, classes, rows = (content.pop(key, None) for key in ("frame_of_reference", "classes", "frames"))
    if not isinstance(classes, list) or not all(isinstance(name, str) for name in classes):
        raise InputError(f'{path}: "classes" must be a list of names, found {classes!r:.40}')
    frames = tuple(_frame(f"{path}: entry {index} of frames", row) for index, row in enumerate(rows))
    content.pop("format")
    return LinesFile(reference, tuple(classes), frames, content)


def _frame(where: str, row: Any) -> FrameLines:
    stamp, lines = stamp_from_json(row, where), row.get("lines")
    if not isinstance(lines, list):
        raise InputError(f'{where}: expected a list "lines", found {lines!r:.60}')
    for index, line in enumerate(lines):
        if not isinstance(line, dict) or not isinstance(line.get("class"), str):
            raise InputError(f'{where}: line {index}: expected an object with "class" and "points", found {line!r:.60}')
    points = tuple(_points(line.get("points"), f"{where}: line {index}") for index, line in enumerate(lines))
    classes = np.array([line["class"] for line in lines], dtype=np.str_)
    scores = None
    if any("score" in line for line in lines):
        scores = np.array([_score(line.get("score"), f"{where}: line {index}") for index, line in enumerate(lines)])
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


class TrueLines:
    """The true lines of a native sequence folder: called with a frame, those in its bev frame, or None.

    The pose of the frame must be known. file: `TRUE_LINES`. Raises InputError where it is wrong.
    """

    def __init__(self, file: Path) -> None:
        lines = read_lines(file)
        self._in_world = lines.frame_of_reference == "world"
        self._lines = {frame.stamp.index: frame.lines for frame in lines.frames}

    def __call__(self, frame: Frame) -> MapLines | None:
        lines = self._lines.get(frame.stamp.index)
        if lines is None:
            return None
        reference_from_ego = frame.world_from_ego.matrix if self._in_world else np.eye(4)
        bev_from_reference = inverse(reference_from_ego @ frame.rig.ego_from_bev)
        return replace(lines, points=tuple(apply(bev_from_reference, points)[:, :2] for points in lines.points))
