"""Labels in a CSV table with the columns of `bevcli export --format csv`."""

import codecs
import csv
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array
from bevcli.parsing.csv_cells import name_of
from bevcli.parsing.files import MIB, read_bytes
from bevcli.sequences.labels.label_format import LabelFormat, LabelledFrame, Labels

LARGEST_BYTES = 512 * MIB
NUMBERS = ("x", "y", "z", "length", "width", "height", "yaw")
OPTIONAL = (
    "frame", "timestamp_ns", "frame_of_reference", "vx", "vy", "attribute", "instance", "visibility", "num_points",
)  # fmt: skip
UNUSED = ("scene", "score", "track_score", "duplicate")  # of an export, without effect on ground truth
SEPARATORS = {";": "semicolons", "\t": "tabs"}
Row = Mapping[str, str]


def read_csv_labels(path: Path) -> Labels:
    """The boxes of a table, one a row. Raises InputError that names the line and the column.

    The separator is a comma, a semicolon or a tab; with semicolons or tabs, numbers may have decimal commas. A byte
    order mark and CRLF are accepted. All of this is detected, and said in the notes.
    """
    text, found = _text(path)
    separator = max(",;\t", key=text.partition("\n")[0].count)
    columns, rows = _rows(path, text, separator)
    table = _Table(path, rows, decimal_comma=separator != "," and any("," in (row["x"] or "") for _, row in rows))
    found += [f"columns separated by {SEPARATORS[separator]}"] if separator in SEPARATORS else []
    found += ["decimal commas"] if table.decimal_comma else []
    notes = [f"found {', '.join(found)}"] if found else []
    others = [name for name in columns if name not in ("class", *NUMBERS, *OPTIONAL, *UNUSED)]
    notes += [f"columns without meaning here are ignored: {', '.join(others)}"] if others else []
    return table.labels(columns, notes)


def _rows(path: Path, text: str, separator: str) -> tuple[list[str], list[tuple[int, Row]]]:
    """The columns, and each row with its line number."""
    reader = csv.DictReader(io.StringIO(text, newline=""), delimiter=separator)
    try:
        columns = [name.strip().lower() for name in reader.fieldnames or ()]
        reader.fieldnames = columns
        _check_columns(path, columns)
        rows: list[tuple[int, Row]] = [(reader.line_num, row) for row in reader]
    except csv.Error as error:
        raise InputError(f"{path}: is not a table ({error})") from None
    for line, row in rows:
        if None in row:
            raise InputError(f"{path}: line {line}: has more cells than the {len(columns)} columns of the first line")
    return columns, rows


def _text(path: Path) -> tuple[str, list[str]]:
    """The text, and the marks of a spreadsheet in it."""
    content, found = read_bytes(path, LARGEST_BYTES), []
    if content.startswith(codecs.BOM_UTF8):
        content, found = content.removeprefix(codecs.BOM_UTF8), ["a byte order mark"]
    try:
        text = content.decode()
    except UnicodeDecodeError:
        raise InputError(f'{path}: is not UTF-8: save it as "CSV UTF-8"') from None
    return text, found + (["lines that end with CRLF"] if "\r\n" in text else [])


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


class _Table:
    """The rows of a file by line number. decimal_comma: of its numbers."""

    def __init__(self, path: Path, rows: list[tuple[int, Row]], *, decimal_comma: bool) -> None:
        self.path, self.rows, self.decimal_comma = path, rows, decimal_comma

    def labels(self, columns: list[str], notes: list[str]) -> Labels:
        """The boxes by frame."""
        frames: dict[tuple[int | None, int | None], list[int]] = {}
        for place, (line, row) in enumerate(self.rows):
            key = (self._integer(line, row, "frame"), self._integer(line, row, "timestamp_ns"))
            if key == (None, None):
                raise InputError(f"{self.path}: line {line}: has neither frame nor timestamp_ns")
            frames.setdefault(key, []).append(place)
        boxes, reference = self._boxes(columns), self._frame_of_reference()
        if "frame_of_reference" not in columns:
            notes = [*notes, 'there is no column frame_of_reference: the boxes are taken to be in the "ego" frame']
        made = (LabelledFrame(index, time, boxes[places]) for (index, time), places in frames.items())
        return Labels(reference, tuple(made), lists_empty=False, notes=tuple(notes))

    def _boxes(self, columns: list[str]) -> Boxes3D:
        numbers = np.array([[self._number(line, row, name) for name in NUMBERS] for line, row in self.rows])
        numbers = numbers.reshape(-1, len(NUMBERS))
        optional = {name: self._optional(name) for name in ("vx", "vy", "visibility", "num_points")}
        points = np.where(np.isnan(optional["num_points"]), -1, optional["num_points"]).astype(np.int64)
        return Boxes3D(
            numbers[:, :3],
            numbers[:, 3:6],
            numbers[:, 6],
            np.column_stack([optional["vx"], optional["vy"]]).reshape(-1, 2),
            self._names("class"),
            attributes=self._names("attribute") if "attribute" in columns else None,
            instances=self._names("instance") if "instance" in columns else None,
            visibilities=optional["visibility"] if "visibility" in columns else None,
            num_points=points if "num_points" in columns else None,
        )

    def _frame_of_reference(self) -> Any:
        stated = {(row.get("frame_of_reference") or "ego").strip() for _, row in self.rows} or {"ego"}
        if len(stated) > 1 or not stated <= {"world", "ego", "bev"}:
            found = ", ".join(sorted(stated))
            raise InputError(
                f"{self.path}: column frame_of_reference: expected world, ego or bev in all rows, found {found}"
            )
        return stated.pop()

    def _names(self, column: str) -> Any:
        names = [name_of((row.get(column) or "").strip()) for _, row in self.rows]
        if column == "class" and "" in names:
            raise InputError(f"{self.path}: line {self.rows[names.index('')][0]}: column class is empty")
        return np.array(names, dtype=np.str_)

    def _optional(self, column: str) -> Array:
        """(N,) numbers, NaN where a cell is empty."""
        cells = [(line, row) if (row.get(column) or "").strip() else None for line, row in self.rows]
        return np.array([np.nan if cell is None else self._number(*cell, column) for cell in cells])

    def _number(self, line: int, row: Row, column: str) -> float:
        cell = (row.get(column) or "").strip()
        try:
            value = float(cell.replace(",", ".") if self.decimal_comma else cell)
        except ValueError:
            value = np.nan
        positive = column in ("length", "width", "height")
        if not np.isfinite(value) or (positive and value <= 0):
            kind = "a number above 0" if positive else "a number"
            raise InputError(f'{self.path}: line {line}: column {column}: expected {kind}, found "{cell:.40}"')
        return value

    def _integer(self, line: int, row: Row, column: str) -> int | None:
        cell = (row.get(column) or "").strip()
        if cell and not cell.isdecimal():
            raise InputError(f'{self.path}: line {line}: column {column}: expected an integer, found "{cell:.40}"')
        return int(cell) if cell else None


FORMAT = LabelFormat(
    "a CSV table (.csv)", lambda path: path.suffix.lower() == ".csv", lambda path, rig, options: read_csv_labels(path)
)
