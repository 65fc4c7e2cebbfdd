"""Warm start: a model to be trained takes what fits of the weights of another model.

Tensors with a row for each class or camera are taken row by row, by name.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from torch import Tensor

from bevcli.checkpoints import Checkpoint, read_checkpoint
from bevcli.config import load_config
from bevcli.errors import InputError, WeightsError
from bevcli.geometry.cameras import CameraRig
from bevcli.model.camera_assignment import assign_cameras
from bevcli.model.config import ModelConfig
from bevcli.model.network import CAMERA_EMBEDDING, Network

LEAST_SHARE = 0.5  # of the model's numbers, that a file must hold
State = Literal["loaded", "new", "unused"]
STATES: tuple[State, ...] = ("loaded", "new", "unused")
Starts = Mapping[str, tuple[str, ...]]


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


@dataclass(frozen=True)
class NamedRows:
    """The names of a tensor's rows.

    Attributes:
        part: the rows in words.
        source: names of the file's rows; empty if the file does not name them.
        starts: name of each row of the model -> the rows of the file that it starts from, as their mean; none for a new
            one.
        remark: on rows that start from one of another name.
    """

    part: str
    source: tuple[str, ...]
    starts: Starts
    remark: str = ""

    def fit(self, found: Tensor, own: Tensor) -> bool:
        """The file names the rows of its tensor, and they have the size of the model's."""
        return len(found) == len(self.source) and found.shape[1:] == own.shape[1:]

    def filled(self, found: Tensor, own: Tensor) -> Tensor:
        """The model's tensor, with the rows that the file has for its names."""
        filled = own.clone()
        for index, origins in enumerate(self.starts.values()):
            if origins:
                filled[index] = found[[self.source.index(each) for each in origins]].float().mean(0)
        return filled

    def count(self, start: WarmStart, size: int) -> None:
        """Count the rows, of so many numbers each."""
        loaded = {name: origins for name, origins in self.starts.items() if origins}
        new = [name for name in self.starts if name not in loaded]
        taken = {each for origins in loaded.values() for each in origins}
        unused = [name for name in self.source if name not in taken]
        start.count("loaded", self.part, self._origins(loaded), size * len(loaded))
        start.count("new", self.part, f"not in the file: {', '.join(new)}", size * len(new))
        start.count("unused", self.part, f"not in the model: {', '.join(unused)}", size * len(unused))

    def _origins(self, loaded: Starts) -> str:
        """The loaded rows in words: each with the row that it starts from, if that has another name."""
        renamed = {name: origins for name, origins in loaded.items() if origins != (name,)}
        origin_of = {name: one if not others else "the mean of all" for name, (one, *others) in renamed.items()}
        texts = [f"{name} from {origin_of[name]}" if name in origin_of else name for name in loaded]
        return ", ".join(texts) + (self.remark if renamed else "")


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
            rows[key].count(start, own[key][0].numel())
            own[key] = rows[key].filled(tensor, own[key])
        else:
            own[key] = _whole(start, key, tensor, own[key], reasons.get(key, ""))
    for key in (key for key in own if key not in state):
        start.count("new", _part(key), "not in the file", own[key].numel(), key)
    _require_share(start)
    model.load_state_dict(own)
    return start


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


def named_rows(checkpoint: Checkpoint, model: Network, rig: Callable[[], CameraRig]) -> dict[str, NamedRows]:
    """The tensors of a model that have a row for each class or each camera, by key.

    Rows of classes start from the class of the same name, else from that which `like` states. Camera embeddings start
    from the camera of the same name, else from the nearest view by heading, else, where no heading is known, from the
    mean of all.

    rig: gives the cameras of a drive to train on; called where names of cameras differ.
    """
    config = model.config
    classes, cameras = _names(checkpoint, config, "classes"), _names(checkpoint, config, "cameras")
    rows = dict.fromkeys(_class_keys(model), NamedRows("class rows", classes, _likes(config, classes)))
    if model.image_tokens.camera_embedding is not None:
        starts, remark = _views(config.cameras, cameras, rig), "; by heading where it is known; all are trained"
        rows[CAMERA_EMBEDDING] = NamedRows("camera embeddings", cameras, starts, remark)
    return rows


def _class_keys(model: Network) -> list[str]:
    """Keys of the tensors that have a row for each class."""
    layers = [
        f"detection_head.class_branches.{branch}.{[*modules.named_children()][-1][0]}"
        for branch, modules in model.detection_head.class_branches.named_children()
    ]
    return [f"{layer}.{kind}" for layer in layers for kind in ("weight", "bias")]


def _names(checkpoint: Checkpoint, config: ModelConfig, what: Literal["classes", "cameras"]) -> tuple[str, ...]:
    """The classes or cameras of a weights file: as it states, or those of the model that it is of; else none."""
    try:
        stated = json.loads(checkpoint.facts.get(what, "null"))
    except ValueError:
        stated = None
    if isinstance(stated, list) and all(isinstance(name, str) for name in stated):
        return tuple(stated)
    name, known = checkpoint.facts.get("model"), checkpoint.models
    if known and (name is None or name in known):
        return tuple(getattr(load_config(known[0]), what))
    return tuple(getattr(config, what)) if name == config.name else ()


def _likes(config: ModelConfig, source: tuple[str, ...]) -> Starts:
    settings = config.class_settings
    likes = {name: settings[name].like if name in settings else "" for name in config.classes}
    return {name: next(((each,) for each in (name, like) if each in source), ()) for name, like in likes.items()}


def _views(cameras: tuple[str, ...], source: tuple[str, ...], rig: Callable[[], CameraRig]) -> Starts:
    views: dict[str, str] = {}
    if source and not set(cameras) <= set(source):
        try:
            assigned = assign_cameras(rig(), source)
            views = dict(zip(assigned.cameras, assigned.embeddings, strict=True))
        except InputError:  # no heading is known for the file's cameras
            views = {}
    return {name: (name,) if name in source else (views[name],) if name in views else source for name in cameras}
