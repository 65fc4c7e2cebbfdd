"""The curves of a training: rows in CSV files, and an image of them."""

from __future__ import annotations

import csv
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from bevcli.errors import OutputError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Row = Mapping[str, float]


class Curve:
    """A CSV file with a column `step`, one row a step. Rows beyond `done` steps, of a killed run, are dropped."""

    def __init__(self, path: Path, done: int = 0) -> None:
        self.path = path
        self.rows: list[Row] = [row for row in _read(path) if row["step"] <= done] if done else []
        aside = path.with_name(f"{path.name}.unfinished")
        try:
            _write(aside, self.rows, "w")
            os.replace(aside, path)
        except OSError as error:
            raise OutputError(f"{path}: cannot be written ({error.strerror})") from None

    def add(self, step: int, numbers: Row) -> None:
        """One more row, in the file at once."""
        row = {"step": step, **numbers}
        _write(self.path, [row], "a", header=not self.rows)
        self.rows.append(row)


def draw(loss: Curve, validation: Curve, path: Path) -> None:
    """Losses (smoothed) beside scores, as a PNG."""
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
    """What lies between 0 and 1: no error, and not every class."""
    return {name: row[name] for name in row if name in ("step", "mAP", "NDS") or name.startswith("IoU")}


def _smoothed(rows: list[Row], points: int = 200) -> list[Row]:
    """Means of equal stretches, at most `points`."""
    size = max(1, len(rows) // points)
    parts = [rows[start : start + size] for start in range(0, len(rows) - size + 1, size)]
    return [{name: sum(row[name] for row in part) / size for name in part[0]} for part in parts]


def _read(path: Path) -> list[Row]:
    if not path.is_file():
        return []
    with path.open(newline="") as file:
        return [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]


def _write(path: Path, rows: list[Row], mode: str, *, header: bool = True) -> None:
    with path.open(mode, newline="") as file:
        if rows:
            writer = csv.DictWriter(file, list(rows[0]))
            if header:
                writer.writeheader()
            writer.writerows({name: f"{value:.6g}" for name, value in row.items()} for row in rows)
