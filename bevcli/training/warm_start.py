"""Warm start: a model to be trained takes what fits of the weights of another model."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from torch import Tensor

from bevcli.checkpoints import read_checkpoint
from bevcli.errors import WeightsError
from bevcli.geometry.cameras import CameraRig
from bevcli.model.network import Network
from bevcli.training.named_rows import NamedRows, named_rows

LEAST_SHARE = 0.5  # of the model's numbers, that a file must hold
State = Literal["loaded", "new", "unused"]
STATES: tuple[State, ...] = ("loaded", "new", "unused")


@dataclass
class WarmStart:
    """The numbers that a training loads, those that are new, and those of the file that it does not use.

    Attributes:
        file: the weights.
        source: the model that they are of, as far as the file says; "" if it is not known.
        model: name or file of the model that is trained.
        rows: by state, part of the model and reason, how many numbers, and an example.
    """

    file: Path
    source: str
    model: str
    rows: dict[tuple[State, str, str], tuple[int, str]] = field(default_factory=dict)

    def count(self, state: State, part: str, reason: str, numbers: int, example: str = "") -> None:
        """Count the numbers of a tensor, or of some of its rows."""
        if numbers:
            before, first = self.rows.get((state, part, reason), (0, example))
            self.rows[state, part, reason] = before + numbers, first

    def numbers(self, state: State) -> int:
        """How many numbers are in a state."""
        return sum(count for (each, *_), (count, _) in self.rows.items() if each == state)

    @property
    def share(self) -> float:
        """Loaded numbers among those of the model, 0 to 1."""
        loaded = self.numbers("loaded")
        return loaded / (loaded + self.numbers("new"))

    def table(self) -> str:
        """A line for each state, part and reason."""
        of = f" (model {self.source})" if self.source else ""
        total = self.numbers("loaded") + self.numbers("new")
        lines = [f"{self.model} starts from {self.file}{of}: {self.share:.1%} of its {total:,} numbers are loaded"]
        width = max(len(part) for _, part, _ in self.rows)
        rows = [(state, *row) for state in STATES for row in self.rows.items() if row[0][0] == state]
        for state, (_, part, reason), (count, example) in rows:
            note = reason + (f" ({example})" if example else "")
            lines.append(f"  {state:6}  {part:{width}}  {count:>11,}  {note}".rstrip())
        return "\n".join(lines)


def warm_start(file: Path, model: Network, model_file: str, rig: Callable[[], CameraRig]) -> WarmStart:
    """Load, in place, every tensor of a weights file that fits a model; the others keep the model's initial values.

    `named_rows` says which rows of classes and cameras are taken. BEV queries of another number of cells over the same
    ground are interpolated. Of more object queries the first are taken, unless the model has several groups of them.

    Args:
        file: an official .pth or a .safetensors of any model.
        model: unchanged where the file holds too little of it.
        model_file: name or TOML file of the model, for the messages.
        rig: gives the cameras of a drive to train on; called where names of cameras differ.

    Raises WeightsError for a file that cannot be read, or with less than `LEAST_SHARE` of the model's numbers.
    """
    checkpoint = read_checkpoint(file)
    start = WarmStart(file, checkpoint.facts.get("model") or " or ".join(checkpoint.models), model_file)
    resampled, rows = model.bev_queries.resampled(checkpoint.state, "bev_queries."), named_rows(checkpoint, model, rig)
    state = model.decoder.first_queries(resampled, "decoder.")
    reasons = dict.fromkeys(rows, "rows in the file's order")
    reasons |= {key: "interpolated from another grid" for key in state if resampled[key] is not checkpoint.state[key]}
    reasons |= {key: "the first queries of the file" for key in state if state[key] is not resampled[key]}
    own = model.state_dict()
    for key, tensor in state.items():
        if key not in own:
            start.count("unused", _part(key), "not in the model", tensor.numel(), key)
        elif key in rows and rows[key].fit(tensor, own[key]):
            own[key] = _named(start, rows[key], tensor, own[key])
        else:
            own[key] = _whole(start, key, tensor, own[key], reasons.get(key, ""))
    for key in (key for key in own if key not in state):
        start.count("new", _part(key), "not in the file", own[key].numel(), key)
    _require_share(start)
    model.load_state_dict(own)
    return start


def _named(start: WarmStart, rows: NamedRows, found: Tensor, own: Tensor) -> Tensor:
    """A tensor with rows by name."""
    size = own[0].numel()
    start.count("loaded", rows.part, rows.origins(), size * len(rows.loaded))
    start.count("new", rows.part, f"not in the file: {', '.join(rows.new)}", size * len(rows.new))
    start.count("unused", rows.part, f"not in the model: {', '.join(rows.unused)}", size * len(rows.unused))
    return rows.filled(found, own)


def _whole(start: WarmStart, key: str, found: Tensor, own: Tensor, reason: str) -> Tensor:
    """A tensor of the file if it has the model's shape, or else the model's. reason: for the line of a loaded one."""
    if found.shape == own.shape:
        start.count("loaded", _part(key), reason, own.numel())
        return found
    shapes = " and ".join(" × ".join(map(str, each.shape)) for each in (found, own))
    start.count("new", _part(key), "another shape in the file", own.numel(), f"{key}: {shapes}")
    start.count("unused", _part(key), "another shape in the model", found.numel())
    return own


def _require_share(start: WarmStart) -> None:
    if start.share < LEAST_SHARE:
        of = f"model {start.source}" if start.source else "an unknown model"
        raise WeightsError(
            f"{start.file}: holds {start.share:.0%} of the numbers of {start.model} (expected at least "
            f"{LEAST_SHARE:.0%}): its weights are of {of}; choose some of a model with the same backbone and channels"
        )


def _part(key: str) -> str:
    return key.partition(".")[0]
