"""plan.csv: planned paths, one row a frame, command and step."""

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from bevcli.frame import FrameStamp, Ground, Plan
from bevcli.parsing.documents import CsvRow, cell_of, read_csv
from bevcli.sequences.files.incremental_json import GrowingFile

COLUMNS = (
    "frame", "scene", "timestamp_ns", "frame_of_reference", "command", "given", "seconds", "x", "y", "z",
)  # fmt: skip


@dataclass(frozen=True)
class FramePlan:
    """The planned paths of one frame. Their points are in frame_of_reference, "world" or "ego"."""

    stamp: FrameStamp
    frame_of_reference: str
    plan: Plan


class PlanWriter(GrowingFile):
    """Writes plan.csv frame by frame; the file is complete after every frame. Raises OutputError."""

    file_name = "plan.csv"

    def __init__(
        self, path: Path, frame_of_reference: str, extras: Mapping[str, Any], resume_at: int | None = None
    ) -> None:
        """resume_at: `size` of an earlier writer of this file, to go on from there. extras: not used."""
        super().__init__(path, resume_at)
        self._reference = frame_of_reference
        if resume_at is None:
            self._append([COLUMNS])

    def write(self, ground: Ground, plan: Plan | None) -> None:
        """Append a frame. plan: in the bev frame; None where the model was not run."""
        if plan is None:
            return
        stamp, rows = ground.stamp, []
        for command, path in zip(plan.commands, ground.points(plan.paths), strict=True):
            given = "true" if command == plan.command else "false"
            head = (stamp.index, cell_of(stamp.scene), stamp.timestamp_ns, self._reference, cell_of(command), given)
            for seconds, point in zip(plan.times_s, path, strict=True):
                rows.append((*head, f"{seconds:g}", *(f"{value:.3f}" for value in point)))
        self._append(rows)

    def _append(self, rows: list[tuple[Any, ...]]) -> None:
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows(rows)
        self.append(text.getvalue().encode())


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
    given, commands, paths = "", [], []
    times = [row.number("seconds") for row in rows if row.cells["command"] == first.cells["command"]]
    for command, steps in groupby(rows, key=lambda row: row.cells["command"]):
        path = list(steps)
        if [row.number("seconds") for row in path] != times:
            raise path[0].error("seconds", "expected the same steps for every command of a frame")
        if path[0].cells["given"] not in ("true", "false"):
            raise path[0].error("given", f'expected true or false, found "{path[0].cells["given"]:.40}"')
        given = command if path[0].cells["given"] == "true" else given
        commands.append(command)
        paths.append([[row.number(axis) for axis in "xyz"] for row in path])
    return FramePlan(stamp, reference, Plan(tuple(commands), np.array(paths), np.array(times), given))
