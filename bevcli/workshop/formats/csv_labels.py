"""Labels in a CSV table with the columns of `bevcli export --format csv`."""

import codecs
import csv
import io
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array
from bevcli.parsing.documents import CsvRow, name_of
from bevcli.parsing.files import MIB, read_bytes
from bevcli.workshop.formats.labels import LabelFormat, LabelledFrame, Labels, Moment

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
    text, found = _text(path)
    separator = max(",;\t", key=text.partition("\n")[0].count)
    columns, rows = _rows(path, text, separator)
    found += [f"columns separated by {SEPARATORS[separator]}"] if separator in SEPARATORS else []
    if separator != "," and any("," in row.cells["x"] for row in rows):
        found.append("decimal commas")
        for row in rows:
            row.cells.update((name, row.cells[name].replace(",", ".")) for name in (*NUMBERS, *OPTIONAL_NUMBERS))
    notes = [f"found {', '.join(found)}"] if found else []
    others = [name for name in columns if name not in ("class", *NUMBERS, *OPTIONAL, *UNUSED)]
    notes += [f"columns without meaning here are ignored: {', '.join(others)}"] if others else []
    if "frame_of_reference" not in columns:
        notes.append('there is no column frame_of_reference: the boxes are taken to be in the "ego" frame')
    moments, boxes = _moments(path, rows), _boxes(rows, columns)
    frames = tuple(LabelledFrame(*moment, boxes[places]) for moment, places in moments.items())
    return Labels(_frame_of_reference(path, rows), frames, lists_empty=False, notes=tuple(notes))


def _text(path: Path) -> tuple[str, list[str]]:
    """The text, and the marks of a spreadsheet in it."""
    content = read_bytes(path, LARGEST_BYTES)
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(f'{path}: is not UTF-8: save it as "CSV UTF-8"') from None
    found = ["a byte order mark"] if content.startswith(codecs.BOM_UTF8) else []
    return text, found + (["lines that end with CRLF"] if "\r\n" in text else [])


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
        stated = zip_longest(columns, map(str.strip, cells), fillvalue="")
        rows.append(CsvRow(path, line, {**dict.fromkeys(OPTIONAL, ""), **dict(stated)}))
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


def _moments(path: Path, rows: list[CsvRow]) -> dict[Moment, list[int]]:
    """Index and time of each frame -> the places of its rows."""
    moments: dict[Moment, list[int]] = {}
    for place, row in enumerate(rows):
        index, time = (row.integer(name) if row.cells[name] else None for name in ("frame", "timestamp_ns"))
        if index is None and time is None:
            raise InputError(f"{path}: line {row.line}: has neither frame nor timestamp_ns")
        moments.setdefault((index, time), []).append(place)
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
    stated = {row.cells["frame_of_reference"] or "ego" for row in rows} or {"ego"}
    if len(stated) > 1 or not stated <= {"world", "ego", "bev"}:
        found = ", ".join(sorted(stated))
        raise InputError(f"{path}: column frame_of_reference: expected world, ego or bev in all rows, found {found}")
    return stated.pop()


FORMAT = LabelFormat(
    "a CSV table (.csv)", lambda path: path.suffix.lower() == ".csv", lambda path, rig, options: read_csv_labels(path)
)
