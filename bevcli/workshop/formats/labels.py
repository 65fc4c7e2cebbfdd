"""A drive with the boxes of a file of labels.

Here is the format of CSV tables with the columns of `bevcli export --format csv`.
"""

import codecs
import csv
import io
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from itertools import groupby, pairwise, zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from bevcli.errors import InputError
from bevcli.frame import DerivedDrive, Drive, Frame, FrameStamp
from bevcli.geometry.boxes import IMPOSSIBLE, Boxes3D
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.transforms import Array
from bevcli.parsing.documents import CsvRow
from bevcli.parsing.files import MIB, read_bytes
from bevcli.printing import counted, name_of
from bevcli.sequences.files.boxes_file import ClassNames, count_classes
from bevcli.sequences.files.boxes_table import COLUMNS
from bevcli.sequences.open import scenes_of
from bevcli.workshop.formats import LabelOptions, UnlistedFrames
from bevcli.workshop.formats.kitti import is_kitti, read_kitti_labels
from bevcli.workshop.formats.label_readings import (
    USUAL,
    LabelledFrame,
    Labels,
    PlacedBoxes,
    check_labels,
    decided,
    fitting,
)
from bevcli.workshop.formats.nuscenes_tables import velocities_between

NEAREST_NS = 50_000_000  # largest difference between the time of a frame and of its labels


def read_labels(path: Path, rig: CameraRig, options: LabelOptions) -> Labels:
    """The labels of a table in CSV, or in KITTI's format. rig: of the drive. Raises InputError."""
    if path.suffix.lower() in (".csv", ".tsv"):
        labels = read_csv_labels(path)
    elif is_kitti(path):
        labels = read_kitti_labels(path, rig, options)
    else:
        expected = "KITTI labels (.txt, or a folder of these), or a table (.csv) with frame or timestamp_ns, class, "
        raise InputError(f"{path}: is no file of labels (expected {expected}{', '.join(NUMBERS)}): convert it to one")
    frames = tuple(
        replace(
            each, boxes=each.boxes.possible(), by_camera={name: of.possible() for name, of in each.by_camera.items()}
        )
        for each in labels.frames
    )
    left_out = sum(len(labelled.boxes) for labelled in labels.frames) - sum(len(labelled.boxes) for labelled in frames)
    note = (f"{counted(left_out, 'boxes')} {IMPOSSIBLE}",) if left_out else ()
    labels = replace(labels, frames=frames, notes=(*labels.notes, *note))
    check_labels(path, labels)
    return labels


class WithLabels(DerivedDrive):
    """A drive whose boxes are those of a file of labels; a map of the drive is kept.

    Labels belong to the frame of the same time, or, where the file has no times, of the same index. Where the file has
    tracks and no velocities, velocities follow from the positions before and after.

    options: of the labels, whose file is `path`. image_check: the images decide what the boxes leave open.

    Raises InputError where the file cannot be read, or where not all of its frames are in the drive.
    """

    def __init__(
        self, sequence: Drive, path: Path, options: LabelOptions = LabelOptions(), image_check: bool = True
    ) -> None:
        super().__init__(sequence)
        labels = read_labels(path, sequence.rig, options)
        boxes, said = _in_world(sequence, labels, path, options, image_check)
        boxes, note = _with_velocities(sequence, boxes)
        unlisted = "unlabelled" if labels.lists_empty else options.unlisted_frames
        labelled = _labelled_frames(sequence.stamps, boxes, unlisted)
        self._listed, self._boxes = len(boxes), {index: Boxes3D.empty() for index in labelled} | boxes
        notes = (*labels.notes, *said, *note, self._summary())
        self.notes = (*sequence.notes, *(f"{path}: {text}" for text in notes))

    @property
    def class_counts(self) -> Mapping[str, int]:
        return count_classes(self._boxes.values())

    def change(self, index: int, frame: Frame) -> Frame:
        return replace(frame, ground_truth=self._boxes.get(index), impossible_boxes=0)

    def _summary(self) -> str:
        counts = ", ".join(f"{name} ({count})" for name, count in sorted(self.class_counts.items()))
        parts = [f"{counted(self._listed, 'frames')} with labels: {counts or 'none'}"]
        empty, unlabelled = len(self._boxes) - self._listed, len(self.stamps) - len(self._boxes)
        if empty:
            parts.append(f"{empty} frames without rows are empty (see `unlisted_frames` (`--unlisted-frames`))")
        if unlabelled:
            parts.append(f"{unlabelled} frames are not labelled: they have no ground truth")
        return "; ".join(parts)


def _labelled_frames(
    stamps: Sequence[FrameStamp], listed: Collection[int], unlisted: UnlistedFrames | None
) -> set[int]:
    """The indices, in the drive, of labelled frames, with or without boxes.

    If a file lists no two successive frames, the labelling tool was given every n-th frame of a scene: the largest n
    that all listed frames fit. Otherwise every frame is labelled.

    listed: the indices that the file has. unlisted: the user's choice for the others; None to decide as above.
    """
    scenes = list(scenes_of(stamps))
    if unlisted == "unlabelled":
        return set(listed)
    if unlisted == "empty" or any(a in listed and b in listed for scene in scenes for a, b in pairwise(scene)):
        return set(range(len(stamps)))
    labelled: set[int] = set()
    for scene in scenes:
        in_scene = [number for number, index in enumerate(scene) if index in listed]
        step = math.gcd(*(later - earlier for earlier, later in pairwise(in_scene))) or len(scene)
        labelled.update(scene[in_scene[0] % step :: step] if in_scene else ())
    return labelled


def _in_world(
    sequence: Drive, labels: Labels, path: Path, options: LabelOptions, image_check: bool
) -> tuple[dict[int, Boxes3D], tuple[str, ...]]:
    """The boxes in the world frame, by index of the frame in the drive; notes on how they are read."""
    times = np.array([stamp.timestamp_ns for stamp in sequence.stamps], dtype=np.int64)
    index_of = {stamp.index: index for index, stamp in enumerate(sequence.stamps)}
    placed: dict[int, PlacedBoxes] = {}
    for labelled in labels.frames:
        index = _index(labelled, times, index_of)
        if index is None:
            raise InputError(
                f"{path}: {_words(labelled)} is not in the drive (expected indices {min(index_of)} to {max(index_of)}, "
                f"times {times.min()} to {times.max()} ns): are these the labels of this drive?"
            )
        if index in placed:
            raise InputError(f"{path}: {_words(labelled)}: its frame of the drive has labels already")
        frame = sequence.ground_truth_frame(index)
        ego = frame.world_from_ego.matrix
        world_from = {"ego": ego, "bev": ego @ frame.rig.ego_from_bev, "world": np.eye(4)}
        placed[index] = PlacedBoxes(frame.stamp.scene, labelled.boxes, world_from, labelled.by_camera)
    stated = {name: value for name in USUAL if (value := getattr(options, name)) is not None}
    stated = {**labels.states, **stated}
    if stated.get("labels_frame") == "world" and not sequence.has_ego_motion:
        raise InputError(f"{path}: its boxes are in the world frame, but the drive has no ego_motion.csv: add it")
    frames = [placed[index] for index in sorted(placed)]
    left = fitting(path, frames, stated)
    of_cameras = [replace(left[0], states={**left[0].states, "labels_camera": name}) for name in labels.cameras]
    left = of_cameras[: None if any(len(each.boxes) for each in frames) else 1] or left
    if image_check and (len(left) > 1 or left[0].doubt):
        from bevcli.workshop.trust.witness import shown_by_images

        left = shown_by_images(sequence, placed, left)
    states, notes = decided(path, frames, left, stated)
    return {index: each.read_as(states) for index, each in placed.items()}, notes


def _with_velocities(sequence: Drive, boxes: dict[int, Boxes3D]) -> tuple[dict[int, Boxes3D], tuple[str, ...]]:
    """The boxes by index, with the velocities of their tracks if none is known, and a note."""
    together = Boxes3D.concatenate(boxes.values())
    if not len(together) or np.isfinite(together.velocities).any():
        return boxes, ()
    has_tracks = together.instances is not None and bool((together.instances != "").any())
    if not has_tracks or not sequence.has_ego_motion:
        needed = "ego-motion" if has_tracks else "a column `instance`"
        return boxes, (f"the velocities of the boxes are not known ({needed} would give them): no box code is trained",)
    filled: dict[int, Boxes3D] = {}
    for _, scene in groupby(sorted(boxes), key=lambda index: sequence.stamps[index].scene):
        indices = list(scene)
        times = [sequence.stamps[index].timestamp_ns for index in indices]
        filled |= zip(indices, with_track_velocities([boxes[index] for index in indices], times), strict=True)
    return filled, ("velocities follow from the tracks",)


def _index(labelled: LabelledFrame, times: np.ndarray, index_of: Mapping[int, int]) -> int | None:
    if labelled.timestamp_ns is None:
        return None if labelled.index is None else index_of.get(labelled.index)
    nearest = int(np.abs(times - labelled.timestamp_ns).argmin())
    return nearest if abs(int(times[nearest]) - labelled.timestamp_ns) <= NEAREST_NS else None


def _words(labelled: LabelledFrame) -> str:
    time = "" if labelled.timestamp_ns is None else f" at {labelled.timestamp_ns} ns"
    return f"the frame{'' if labelled.index is None else f' {labelled.index}'}{time}"


def with_track_velocities(frames: Sequence[Boxes3D], timestamps_ns: Sequence[int]) -> list[Boxes3D]:
    """The boxes of T frames, in the world frame, with the velocities that follow from their `instances`; "" is none.

    timestamps_ns: (T,) increasing.
    """
    together = Boxes3D.concatenate(frames)
    if together.instances is None:
        return list(frames)
    counts = [len(boxes) for boxes in frames]
    seconds = np.repeat((np.asarray(timestamps_ns) - timestamps_ns[0]) * 1e-9, counts)
    order = np.lexsort((seconds, together.instances))
    names = together.instances[order]
    same = (names[1:] == names[:-1]) & (names[1:] != "")
    first, last = np.arange(len(order)), np.arange(len(order))
    first[order[1:][same]], last[order[:-1][same]] = order[:-1][same], order[1:][same]
    velocities = velocities_between(together.centers, seconds, first, last)[:, :2]
    parts = np.split(velocities, np.cumsum(counts)[:-1])
    return [replace(boxes, velocities=of_frame) for boxes, of_frame in zip(frames, parts, strict=True)]


LARGEST_BYTES = 512 * MIB
NUMBERS = ("x", "y", "z", "length", "width", "height", "yaw")
OPTIONAL_NUMBERS = ("vx", "vy", "visibility", "num_points")
OPTIONAL = ("frame", "timestamp_ns", "frame_of_reference", "attribute", "instance", *OPTIONAL_NUMBERS)
UNUSED = ("scene", "score", "track_score", "duplicate")  # of an export, without effect on ground truth
SEPARATORS = {";": "semicolons", "\t": "tabs"}


def read_csv_labels(path: Path) -> Labels:
    """The boxes of a table, one a row. Raises InputError that names the line and the column.

    The separator is a comma, a semicolon or a tab; with semicolons or tabs, numbers may have decimal commas. A byte
    order mark and CRLF are accepted. All of this is detected, and said in the notes.
    """
    text, marks = _text(path)
    separator = max(",;\t", key=text.partition("\n")[0].count)
    columns, rows = _rows(path, text, separator)
    marks += [f"columns separated by {SEPARATORS[separator]}"] if separator in SEPARATORS else []
    if separator != "," and any("," in row.cells["x"] for row in rows):
        marks.append("decimal commas")
        for row in rows:
            row.cells.update((name, row.cells[name].replace(",", ".")) for name in (*NUMBERS, *OPTIONAL_NUMBERS))
    notes = [f"found {', '.join(marks)}"] if marks else []
    others = [name for name in columns if name not in ("class", *NUMBERS, *OPTIONAL, *UNUSED)]
    notes += [f"columns without meaning here are ignored: {', '.join(others)}"] if others else []
    moments, boxes = _moments(path, rows), _boxes(rows, columns)
    frames = tuple(LabelledFrame(*moment, boxes[numbers]) for moment, numbers in moments.items())
    states = dict(USUAL) if set(COLUMNS) <= set(columns) else {}  # bevcli wrote it
    states |= {"labels_frame": _frame_of_reference(path, rows)} if "frame_of_reference" in columns else {}
    return Labels(states, frames, lists_empty=False, notes=tuple(notes))


def _text(path: Path) -> tuple[str, list[str]]:
    """The text, and the marks of a spreadsheet in it."""
    content = read_bytes(path, LARGEST_BYTES)
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(f'{path}: is not UTF-8: save it as "CSV UTF-8"') from None
    marks = ["a byte order mark"] if content.startswith(codecs.BOM_UTF8) else []
    return text, marks + (["lines that end with CRLF"] if "\r\n" in text else [])


def _rows(path: Path, text: str, separator: str) -> tuple[list[str], list[CsvRow]]:
    """The columns, and the rows; cells that a row does not have are empty."""
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=separator)
    try:
        columns = [name.strip().lower() for name in next(reader, ())]
        _check_columns(path, columns)
        lines = [(reader.line_num, cells) for cells in reader if cells]
    except csv.Error as error:
        raise InputError(f"{path}: is not a table ({error})") from None
    rows = []
    for line, cells in lines:
        if len(cells) > len(columns):
            raise InputError(f"{path}: line {line}: has more cells than the {len(columns)} columns of the first line")
        pairs = zip_longest(columns, map(str.strip, cells), fillvalue="")
        rows.append(CsvRow(path, line, {**dict.fromkeys(OPTIONAL, ""), **dict(pairs)}))
    return columns, rows


def _check_columns(path: Path, columns: list[str]) -> None:
    missing = [name for name in ("class", *NUMBERS) if name not in columns]
    if not {"frame", "timestamp_ns"} & set(columns):
        missing.append("frame or timestamp_ns")
    if missing:
        raise InputError(
            f"{path}: column {missing[0]} is missing (expected those of `bevcli export --format csv`: frame, "
            f"timestamp_ns, class, {', '.join(NUMBERS)}; found {', '.join(columns) or 'none'})"
        )
    if len(set(columns)) < len(columns):
        raise InputError(f"{path}: two columns have one name (found {', '.join(columns)})")


def _moments(path: Path, rows: list[CsvRow]) -> dict[tuple[int | None, int | None], list[int]]:
    """Index and time of each frame -> the numbers of its rows."""
    moments: dict[tuple[int | None, int | None], list[int]] = {}
    for number, row in enumerate(rows):
        index, time = (row.integer(name) if row.cells[name] else None for name in ("frame", "timestamp_ns"))
        if index is None and time is None:
            raise InputError(f"{path}: line {row.line}: has neither frame nor timestamp_ns")
        moments.setdefault((index, time), []).append(number)
    return moments


def _boxes(rows: list[CsvRow], columns: list[str]) -> Boxes3D:
    numbers = np.array([[row.number(name) for name in NUMBERS] for row in rows]).reshape(-1, len(NUMBERS))
    for row in rows:
        if not row.cells["class"]:
            raise row.error("class", "is empty (expected the name of a class)")
    points = _optional(rows, "num_points")
    return Boxes3D(
        numbers[:, :3],
        numbers[:, 3:6],
        numbers[:, 6],
        np.column_stack([_optional(rows, "vx"), _optional(rows, "vy")]).reshape(-1, 2),
        _names(rows, "class"),
        attributes=_names(rows, "attribute") if "attribute" in columns else None,
        instances=_names(rows, "instance") if "instance" in columns else None,
        visibilities=_optional(rows, "visibility") if "visibility" in columns else None,
        num_points=np.where(np.isnan(points), -1, points).astype(np.int64) if "num_points" in columns else None,
    )


def _optional(rows: list[CsvRow], column: str) -> Array:
    """(N,) numbers, NaN where a cell is empty."""
    return np.array([row.number(column) if row.cells[column] else np.nan for row in rows])


def _names(rows: list[CsvRow], column: str) -> Any:
    return np.array([name_of(row.cells[column]) for row in rows], dtype=np.str_)


def _frame_of_reference(path: Path, rows: list[CsvRow]) -> Any:
    references = {row.cells["frame_of_reference"] or "ego" for row in rows} or {"ego"}
    if len(references) > 1 or not references <= {"world", "ego", "bev"}:
        names = ", ".join(sorted(references))
        raise InputError(f"{path}: column frame_of_reference: expected world, ego or bev in all rows, found {names}")
    return references.pop()


def names_of_format(table: Mapping[str, str], renames: Mapping[str, str]) -> ClassNames:
    """The names of a format that has names of its own. table: its names -> nuScenes' classes.

    A name that the user renames keeps its name, so that `renames` finds it.
    """
    renamed = {name.lower() for name in renames}
    return ClassNames({name: target for name, target in table.items() if name.lower() not in renamed})
