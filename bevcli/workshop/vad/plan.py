"""Planned paths of the vehicle, plan.csv (one row a frame, command and step), and their drawing."""

import csv
import io
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from bevcli.frame import FrameResult, FrameStamp, Ground, GroundLines
from bevcli.geometry.object_classes import Color
from bevcli.geometry.transforms import Array
from bevcli.parsing.documents import CsvRow, read_csv
from bevcli.printing import cell_of
from bevcli.recording.entities import EGO_COLOR
from bevcli.sequences.files.incremental_json import GrowingFile

COLUMNS = (
    "frame", "scene", "timestamp_ns", "frame_of_reference", "command", "given", "seconds", "x", "y", "z",
)  # fmt: skip
OPAQUE, HALF, FAINT = 230, 90, 45  # of 255: the path of the command, the other paths, the rungs of the ribbon
WIDTH = 1.2  # points of the user interface
HALF_VEHICLE_M = 0.925
RUNG_M = 0.4  # of a ribbon


class PlanWriter(GrowingFile):
    """Writes plan.csv frame by frame; the file is complete after every frame. Raises OutputError."""

    def __init__(
        self, path: Path, frame_of_reference: str, extras: Mapping[str, Any], resume_at: int | None = None
    ) -> None:
        """resume_at: `size` of an earlier writer of this file, to go on from there. extras: not used."""
        super().__init__(path, resume_at)
        self._reference = frame_of_reference
        if resume_at is None:
            self._append([COLUMNS])

    def write(self, ground: Ground, plan: "Plan | None") -> None:
        """Append a frame. plan: in the bev frame; None where the model was not run."""
        if plan is None:
            return
        stamp, rows = ground.stamp, []
        for command, path in zip(plan.commands, ground.points(plan.paths), strict=True):
            is_given = "true" if command == plan.command else "false"
            head = (stamp.index, cell_of(stamp.scene), stamp.timestamp_ns, self._reference, cell_of(command), is_given)
            for seconds, point in zip(plan.times_s, path, strict=True):
                rows.append((*head, f"{seconds:g}", *(f"{value:.3f}" for value in point)))
        self._append(rows)

    def _append(self, rows: list[tuple[Any, ...]]) -> None:
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows(rows)
        self.append(text.getvalue().encode())


@dataclass(frozen=True)
class Plan(FrameResult):
    """Planned paths of the vehicle, one for each command of the driver."""

    kind = "plan"
    file_name = "plan.csv"
    writer = PlanWriter
    takes_command = True

    commands: tuple[str, ...]  # names of the C commands
    # (C, T, 2) x and y in the bev frame, or (C, T, 3) points on the ground in the ego or world frame, metres: future
    # places of the origin of the bev frame
    paths: Array
    times_s: Array  # (T,) seconds from the frame's time
    command: str = ""  # the one that was given, "" for none

    @classmethod
    def legend(cls, names: tuple[str, ...]) -> dict[str, Color]:
        return {"planned path": EGO_COLOR}

    def drawn(self, ground: Ground, names: tuple[str, ...], score: float) -> GroundLines:
        """Each path as a line, and the one of the command as a ribbon as wide as the vehicle."""
        strips, colors = [], []
        for command, path in zip(self.commands, self.paths, strict=True):
            whole = np.concatenate([np.zeros((1, 2)), path])
            ribbon = list(_ribbon(whole)) if command == self.command else []
            strips += [ground.points(line) for line in (*ribbon, whole)]
            colors += [(*EGO_COLOR, FAINT if len(line) == 2 else OPAQUE) for line in ribbon]
            colors.append((*EGO_COLOR, OPAQUE if ribbon else HALF))
        return GroundLines(strips, colors, WIDTH)

    def with_command(self, command: str) -> "Plan":
        return replace(self, command=command)


def _ribbon(path: Array) -> Iterator[Array]:
    """The two sides of a ribbon along a path (K, 2), and its rungs."""
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    if along[-1] < RUNG_M:
        return
    at = np.linspace(0, along[-1], int(along[-1] / RUNG_M) + 2)
    middle = np.stack([np.interp(at, along, axis) for axis in path.T], axis=-1)
    ahead = np.gradient(middle, axis=0)
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
    across = HALF_VEHICLE_M * np.stack([ahead[:, 1], -ahead[:, 0]], axis=-1)
    yield from (middle - across, middle + across)
    yield from np.stack([middle - across, middle + across], axis=1)


@dataclass(frozen=True)
class FramePlan:
    """The planned paths of one frame. Their points are in frame_of_reference, "world" or "ego"."""

    stamp: FrameStamp
    frame_of_reference: str
    plan: Plan


def read_plans(path: Path) -> tuple[FramePlan, ...]:
    """The plans in plan.csv, in its order; frames without one are left out. Raises InputError."""
    rows = read_csv(path, COLUMNS)
    of_frames = groupby(rows, key=lambda row: (row.cells["frame"], row.cells["scene"], row.cells["timestamp_ns"]))
    return tuple(_frame_plan(list(group)) for _, group in of_frames)


def _frame_plan(rows: list[CsvRow]) -> FramePlan:
    first = rows[0]
    stamp = FrameStamp(first.integer("frame"), first.cells["scene"], first.integer("timestamp_ns"))
    reference = first.cells["frame_of_reference"]
    if reference not in ("world", "ego"):
        raise first.error("frame_of_reference", f'expected world or ego, found "{reference:.40}"')
    given_command, commands, paths = "", [], []
    times = [row.number("seconds") for row in rows if row.cells["command"] == first.cells["command"]]
    for command, steps in groupby(rows, key=lambda row: row.cells["command"]):
        path = list(steps)
        if [row.number("seconds") for row in path] != times:
            raise path[0].error("seconds", "expected the same steps for every command of a frame")
        if path[0].cells["given"] not in ("true", "false"):
            raise path[0].error("given", f'expected true or false, found "{path[0].cells["given"]:.40}"')
        given_command = command if path[0].cells["given"] == "true" else given_command
        commands.append(command)
        paths.append([[row.number(axis) for axis in "xyz"] for row in path])
    return FramePlan(stamp, reference, Plan(tuple(commands), np.array(paths), np.array(times), given_command))
