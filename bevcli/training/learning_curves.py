"""Learning curves: losses and scores by step, as CSV files and as a plot."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from bevcli.errors import InputError
from bevcli.parsing.files import MIB, read_text
from bevcli.training.checkpoint import replace_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Row = Mapping[str, float]
LARGEST_BYTES = 256 * MIB


class LearningCurve:
    """A CSV file with a column `step` and one row a step.

    Attributes:
        path: the file.
        rows: what is in it.
    """

    def __init__(self, path: Path, done: int = 0) -> None:
        """Opens the file of a resumed training, or starts a new one.

        Raises OutputError, and InputError for a damaged file.

        Args:
            done: steps done. Rows after them, of an interrupted run, are dropped; 0 starts a new file.
        """
        self.path = path
        self.rows: list[Row] = [row for row in _read(path) if row["step"] <= done] if done else []
        replace_file(path, lambda unfinished: _write(unfinished, self.rows, "w"))

    def add(self, step: int, numbers: Row) -> None:
        """Appends a row and writes it to the file at once."""
        row = {"step": step, **numbers}
        _write(self.path, [row], "a", header=not self.rows)
        self.rows.append(row)


def draw_learning_curves(loss: LearningCurve, validation: LearningCurve, path: Path) -> None:
    """Writes a PNG: smoothed losses on the left, scores on the right."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 4.5), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    _draw_rows(left, _smoothed(loss.rows), skipped=("step", "learning rate", "gradient norm"))
    _draw_rows(right, [_scores(row) for row in validation.rows], skipped=("step",), marker="o")
    left.set(title="Training loss", xlabel="step", yscale="log")
    right.set(title="Validation", xlabel="step", ylim=(0, 1))
    figure.savefig(path, dpi=110)


def _draw_rows(axes: Axes, rows: list[Row], skipped: tuple[str, ...], marker: str = "") -> None:
    for name in rows[0] if rows else ():
        if name not in skipped:
            axes.plot([row["step"] for row in rows], [row[name] for row in rows], label=name, marker=marker)
    if rows:
        axes.legend(fontsize=8)
    axes.grid(alpha=0.3)


def _scores(row: Row) -> Row:
    """The step and the scores from 0 to 1 over all classes: mAP, NDS and IoU."""
    return {name: row[name] for name in row if name in ("step", "mAP", "NDS") or name.startswith("IoU")}


def _smoothed(rows: list[Row], points: int = 200) -> list[Row]:
    """Means over blocks of equal length, at least `points` blocks if there are so many rows."""
    size = max(1, len(rows) // points)
    blocks = [rows[start : start + size] for start in range(0, len(rows) - size + 1, size)]
    return [{name: sum(row[name] for row in block) / size for name in block[0]} for block in blocks]


def _read(path: Path) -> list[Row]:
    """The rows of a file. Raises InputError."""
    if not path.is_file():
        return []
    text = read_text(path, LARGEST_BYTES)
    try:
        rows: list[Row] = [
            {name: float(value) for name, value in row.items()} for row in csv.DictReader(io.StringIO(text))
        ]
    except (ValueError, TypeError, csv.Error) as error:  # no number, a missing or an additional one, a null byte
        raise InputError(f"{path}: is damaged ({error}): move it away, or start a new training") from None
    if rows and "step" not in rows[0]:
        raise InputError(f"{path}: has no column step: move it away, or start a new training")
    return rows


def _write(path: Path, rows: list[Row], mode: str, *, header: bool = True) -> None:
    with path.open(mode, newline="") as file:
        if rows:
            writer = csv.DictWriter(file, list(rows[0]))
            if header:
                writer.writeheader()
            writer.writerows({name: f"{value:.6g}" for name, value in row.items()} for row in rows)
