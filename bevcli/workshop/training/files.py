"""Files of a training: resumable checkpoints, released weights, and learning curves, for TensorBoard too.

A file is written under a temporary name and renamed: a kill leaves the old one intact.
"""

from __future__ import annotations

import contextlib
import csv
import importlib.util
import io
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import safetensors.torch
import torch
from torch import Tensor, nn

from bevcli.errors import BevcliError, InputError, WeightsError
from bevcli.inference.training_rigs import weights_facts
from bevcli.model.network import Network
from bevcli.parsing.files import MIB, read_text
from bevcli.parsing.pth import read_pth
from bevcli.writing import output_errors, whole_file, write_whole

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FORMAT = "bevcli-training/1"
LARGEST_CSV_BYTES = 256 * MIB
Row = Mapping[str, float]
# What PyTorch raises for contents that belong to another model.
_DAMAGE = (RuntimeError, ValueError, LookupError, TypeError, AttributeError, OverflowError)


def save_checkpoint(
    path: Path,
    step: int,
    trained: nn.Module,
    optimizer: torch.optim.AdamW,
    average: Mapping[str, Tensor] | None = None,
) -> None:
    """Writes the state after `step` steps, to resume from. Random numbers are drawn from seed and step, not stored.

    trained: the model and its auxiliary heads. average: the running average of the model's weights, None without one.
    """
    contents = {"format": FORMAT, "step": step, "model": trained.state_dict(), "optimizer": optimizer.state_dict()}
    if average is not None:
        contents["average"] = dict(average)
    with whole_file(path) as unfinished:
        torch.save(contents, unfinished)


def load_checkpoint(
    path: Path, trained: nn.Module, optimizer: torch.optim.AdamW, average: dict[str, Tensor] | None = None
) -> int:
    """Restores model, auxiliary heads, optimizer and, in place, the running average of the weights.

    Returns the number of steps done. Raises WeightsError.
    """
    if not path.exists():
        raise WeightsError(f"{path}: no checkpoint to resume from; leave out `resume` to start a training")
    file = read_pth(path)
    if file.left_out:
        raise WeightsError(f"{path}: is not a checkpoint of this model: it holds objects ({file.left_out[0]:.100})")
    try:
        contents = file.with_tensors()
        if contents["format"] != FORMAT:
            raise WeightsError(f'{path}: "format" must be "{FORMAT}", found {contents["format"]!r:.60}')
        trained.load_state_dict(contents["model"])
        settings = [dict(group) for group in optimizer.param_groups]
        optimizer.load_state_dict(contents["optimizer"])
        for group, own in zip(optimizer.param_groups, settings, strict=True):
            group.update(own)  # of this training, not of the file
        for key, value in {} if average is None else average.items():
            value.copy_(contents["average"][key])
        _check_numbers(optimizer, [*trained.state_dict().values(), *(average or {}).values()])
        if type(contents["step"]) is not int or contents["step"] < 0:
            raise ValueError(f"its step is {contents['step']!r:.40} (expected an integer, 0 or more)")
        return contents["step"]
    except _DAMAGE as error:
        reason = " ".join(line.strip() for line in str(error).split("\n")[:2])
        raise WeightsError(f"{path}: is not a checkpoint of this model: {reason}") from error


def _check_numbers(optimizer: torch.optim.AdamW, tensors: list[Tensor]) -> None:
    """Raises ValueError for what PyTorch takes: moments of a wrong shape or sign, NaN in them or in `tensors`."""
    for parameter, own in optimizer.state.items():
        first, second, step = (own[name] for name in ("exp_avg", "exp_avg_sq", "step"))
        if not first.shape == second.shape == parameter.shape or step.shape or min(step, second.min()) < 0:
            raise ValueError("the optimizer's moments do not fit the weights")
        tensors = [*tensors, first, second, step]
    if not all(torch.isfinite(tensor).all() for tensor in tensors):
        raise ValueError("some of its numbers are NaN or infinite")


def save_weights(path: Path, model: Network, dtype: torch.dtype) -> None:
    """Writes the model's weights as .safetensors, for `bevcli run --weights`, with the frame and rigs they expect."""
    state = {
        key: (tensor.to(dtype) if tensor.is_floating_point() else tensor).contiguous().cpu()
        for key, tensor in model.state_dict().items()
    }
    write_whole(path, safetensors.torch.save(state, weights_facts(model.config)))


class LearningCurve:
    """A CSV file with a column `step` and one row a step, and TensorBoard's curves of the same numbers.

    Attributes:
        path: the file.
        rows: its rows.
    """

    def __init__(self, path: Path, done: int = 0, group: str = "", events: Any = None) -> None:
        """Opens the file of a resumed training, or starts a new one.

        done: steps done. Rows after them, of an interrupted run, are dropped; 0 starts a new file.
        group: of the curves in TensorBoard, before their names. events: of `event_writer`; None for no such curves.
        Raises OutputError, and InputError for a damaged file.
        """
        self.path, self._group, self._events = path, group, events
        self.rows: list[Row] = [row for row in _read(path) if row["step"] <= done] if done else []
        with whole_file(path) as unfinished:
            _write(unfinished, self.rows, "w")

    def add(self, step: int, numbers: Row) -> None:
        """Appends a row and writes it to the files at once, finite numbers only for TensorBoard."""
        row = {"step": step, **numbers}
        _write(self.path, [row], "a", header=not self.rows)
        self.rows.append(row)
        if self._events is not None:
            for name, value in numbers.items():
                if math.isfinite(value):
                    self._events.add_scalar(f"{self._group}/{name}", value, step)
            self._events.flush()


def draw_learning_curves(loss: LearningCurve, validation: LearningCurve, path: Path) -> None:
    """Writes a PNG: smoothed losses on the left, scores on the right."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 4.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    _draw_rows(left, _smoothed(loss.rows), skipped=("step", "learning rate", "gradient norm"))
    _draw_rows(right, [_scores(row) for row in validation.rows], skipped=("step",), marker="o")
    left.set(title="Training loss", xlabel="step", yscale="log")
    right.set(title="Validation", xlabel="step", ylim=(0, 1))
    with whole_file(path) as unfinished:
        figure.savefig(unfinished, dpi=110)


def _draw_rows(axes: Axes, rows: list[Row], skipped: tuple[str, ...], marker: str = "") -> None:
    for name in rows[0] if rows else ():
        values = [row[name] for row in rows]
        if name not in skipped and not all(map(math.isnan, values)):
            axes.plot([row["step"] for row in rows], values, label=name, marker=marker)
    if rows:
        axes.legend(fontsize=8)
    axes.grid(alpha=0.3)


def _scores(row: Row) -> Row:
    return {name: row[name] for name in row if name in ("step", "mAP", "NDS") or name.startswith("IoU")}


def _smoothed(rows: list[Row], points: int = 200) -> list[Row]:
    """Means over blocks of equal length, at least `points` blocks if there are so many rows."""
    size = max(1, len(rows) // points)
    blocks = [rows[start : start + size] for start in range(0, len(rows) - size + 1, size)]
    return [{name: sum(row[name] for row in block) / size for name in block[0]} for block in blocks]


def _read(path: Path) -> list[Row]:
    """The rows of a file, without damaged ones. Raises InputError."""
    if not path.is_file():
        return []
    text = read_text(path, LARGEST_CSV_BYTES)
    rows: list[Row] = []
    try:
        for row in csv.DictReader(io.StringIO(text)):
            with contextlib.suppress(ValueError, TypeError):  # half a row, from a full disk
                rows.append({name: float(value) for name, value in row.items()})
    except csv.Error as error:
        raise InputError(f"{path}: {error}: move it away, or start a new training") from None
    if rows and "step" not in rows[0]:
        raise InputError(f"{path}: has no column step: move it away, or start a new training")
    return rows


def _write(path: Path, rows: list[Row], mode: str, *, header: bool = True) -> None:
    with output_errors(path), path.open(mode, newline="") as file:
        if rows:
            writer = csv.DictWriter(file, list(rows[0]))
            if header:
                writer.writeheader()
            writer.writerows({name: f"{value:.6g}" for name, value in row.items()} for row in rows)


def require_tensorboard() -> None:
    """Raise BevcliError where the package tensorboard is not installed."""
    if importlib.util.find_spec("tensorboard") is None:
        raise BevcliError("`log=\"tensorboard\"` needs the package tensorboard: pip install 'bevcli[tensorboard]'")


def event_writer(folder: Path, done: int) -> Any:
    """A writer of event files: `tensorboard --logdir FOLDER` draws them, also while the training runs.

    done: steps done. TensorBoard hides later ones, of an interrupted training.
    """
    from torch.utils.tensorboard import SummaryWriter

    return SummaryWriter(str(folder), purge_step=done + 1 if done else None)
