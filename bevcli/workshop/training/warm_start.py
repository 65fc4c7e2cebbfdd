"""Warm start: a model to be trained takes what fits of the weights of another model, or its backbone from ImageNet.

Tensors with a row for each class or camera are taken row by row, by name.
"""

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from torch import Tensor, nn

from bevcli.checkpoints import INTEGER_KEY, Checkpoint, read_checkpoint
from bevcli.config import load_config
from bevcli.errors import InputError, WeightsError
from bevcli.model.config import ImageConfig, ModelConfig
from bevcli.model.efficientnet_lite import EfficientNetLiteConfig
from bevcli.model.network import CAMERA_EMBEDDING, Network
from bevcli.model.step import assign_cameras
from bevcli.workshop.synth.drives import Drives

LEAST_SHARE = 0.5  # of the model's numbers, that a file must hold
State = Literal["loaded", "new", "unused"]
STATES: tuple[State, ...] = ("loaded", "new", "unused")
Starts = Mapping[str, tuple[str, ...]]


@dataclass
class WarmStart:
    """The numbers that a training loads, those that are new, and those of the file that it does not use."""

    file: Path  # the weights
    source: str  # the model that they are of, as far as the file says; "" if it is not known
    model: str  # name or file of the model that is trained
    # by state, part of the model and reason, how many numbers, and an example
    rows: dict[tuple[State, str, str], tuple[int, str]] = field(default_factory=dict)

    def count(self, state: State, part: str, reason: str, numbers: int, example: str = "") -> None:
        """Count the numbers of a tensor, or of some of its rows."""
        if numbers:
            before, first = self.rows.get((state, part, reason), (0, example))
            self.rows[state, part, reason] = before + numbers, first

    def numbers(self, state: State, of_part: str = "") -> int:
        """How many numbers are in a state, of all parts or of one."""
        rows = ((part, count) for (counted, part, _), (count, _) in self.rows.items() if counted == state)
        return sum(count for part, count in rows if of_part in ("", part))

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
    """The names of a tensor's rows."""

    part: str  # the rows in words
    source: tuple[str, ...]  # names of the file's rows; empty if the file does not name them
    starts: Starts  # row of the model -> rows of the file, of which it takes the mean; none for a new one
    remark: str = ""  # on rows that start from one of another name

    def fit(self, rows: Tensor, tensor: Tensor) -> bool:
        """The file names the rows of its tensor, and they have the size of the model's."""
        return len(rows) == len(self.source) and rows.shape[1:] == tensor.shape[1:]

    def filled(self, rows: Tensor, tensor: Tensor) -> Tensor:
        """The model's tensor, with the rows that the file has for its names."""
        filled = tensor.clone()
        for index, origins in enumerate(self.starts.values()):
            if origins:
                filled[index] = rows[[self.source.index(name) for name in origins]].float().mean(0)
        return filled

    def count(self, start: WarmStart, size: int) -> None:
        """Count the rows, of so many numbers each."""
        loaded = {name: origins for name, origins in self.starts.items() if origins}
        new = [name for name in self.starts if name not in loaded]
        taken = {name for origins in loaded.values() for name in origins}
        unused = [name for name in self.source if name not in taken]
        start.count("loaded", self.part, self._origins(loaded), size * len(loaded))
        start.count("new", self.part, f"not in the file: {', '.join(new)}", size * len(new))
        start.count("unused", self.part, f"not in the model: {', '.join(unused)}", size * len(unused))

    def _origins(self, loaded: Starts) -> str:
        """The loaded rows in words: each with the row that it starts from, if that has another name."""
        renamed = {name: origins for name, origins in loaded.items() if origins != (name,)}
        origin_of = {name: "the mean of all" if others else first for name, (first, *others) in renamed.items()}
        texts = [f"{name} from {origin_of[name]}" if name in origin_of else name for name in loaded]
        return ", ".join(texts) + (self.remark if renamed else "")


def warm_start(
    file: Path, model: Network, model_file: str, drives: Drives, *, another_backbone: bool = False
) -> WarmStart:
    """Load, in place, every tensor of a weights file that fits a model; the others keep the model's initial values.

    `named_rows` says which rows of classes and cameras are taken. BEV queries of another number of cells over the same
    ground are interpolated. Of more object queries the first are taken, unless the model has several groups of them.

    Args:
        file: an official .pth or a .safetensors of any model.
        model: unchanged where the file holds too little of it.
        model_file: name or TOML file of the model, for the messages.
        drives: to train on, whose first gives the cameras where their names differ.
        another_backbone: the file may have another backbone than the model.

    Raises WeightsError for a file that cannot be read, has another backbone, or less than `LEAST_SHARE` of the numbers.
    """
    checkpoint = read_checkpoint(file)
    start = WarmStart(file, checkpoint.facts.get("model") or " or ".join(checkpoint.models), model_file)
    resampled, rows = resampled_queries(model, checkpoint.state), named_rows(checkpoint, model, drives)
    state = first_queries(model, resampled)
    reasons = dict.fromkeys(rows, "rows in the file's order")
    reasons |= {key: "interpolated from another grid" for key in state if resampled[key] is not checkpoint.state[key]}
    reasons |= {key: "the first queries of the file" for key in state if state[key] is not resampled[key]}
    model_state = model.state_dict()
    for key, tensor in state.items():
        if key not in model_state:
            start.count("unused", _network_part(key), "not in the model", tensor.numel(), key)
        elif key in rows and rows[key].fit(tensor, model_state[key]):
            rows[key].count(start, model_state[key][0].numel())
            model_state[key] = rows[key].filled(tensor, model_state[key])
        else:
            model_state[key] = _whole(start, key, tensor, model_state[key], reasons.get(key, ""))
    for key in (key for key in model_state if key not in state):
        start.count("new", _network_part(key), "not in the file", model_state[key].numel(), key)
    of = f"model {start.source}" if start.source else "an unknown model"
    if not another_backbone and start.numbers("new", "backbone") > start.numbers("loaded", "backbone"):
        raise WeightsError(
            f"{file}: its backbone does not fit that of {model_file}: its weights are of {of}; write a model file for "
            "them with `--init` and the `--preset` of that model, or name the backbone to start from: "
            "`backbone_weights` (`--backbone-weights`)"
        )
    if start.share < LEAST_SHARE:
        raise WeightsError(
            f"{file}: holds {start.share:.0%} of the numbers of {model_file} (expected at least "
            f"{LEAST_SHARE:.0%}): its weights are of {of}; choose some of a model with the same backbone and channels"
        )
    model.load_state_dict(model_state)
    return start


def resampled_queries(model: Network, state: Mapping[str, Tensor]) -> Mapping[str, Tensor]:
    """A state dict whose BEV queries are interpolated to the grid of a model, which covers the same area.

    It is the same state dict where that holds no BEV queries or where these fit already.
    """
    row_key, column_key, key = (f"bev_queries.{name}" for name in ("row_embedding", "column_embedding", "embedding"))
    if not {row_key, column_key, key} <= set(state):
        return state
    sizes = len(model.bev_queries.row_embedding), len(model.bev_queries.column_embedding)
    file_sizes = len(state[row_key]), len(state[column_key])
    if file_sizes == sizes or len(state[key]) != file_sizes[0] * file_sizes[1]:
        return state
    cells = state[key].float().unflatten(0, file_sizes).permute(2, 0, 1)[None]  # (1, C, rows, columns)
    return {
        **state,
        key: nn.functional.interpolate(cells, sizes, mode="bilinear")[0].flatten(1).T,
        row_key: _interpolated(state[row_key], sizes[0]),
        column_key: _interpolated(state[column_key], sizes[1]),
    }


def _interpolated(rows: Tensor, count: int) -> Tensor:
    """(N, C) -> (count, C), linearly."""
    return nn.functional.interpolate(rows.float().T[None], count, mode="linear")[0].T


def first_queries(model: Network, state: Mapping[str, Tensor]) -> Mapping[str, Tensor]:
    """A state dict with the first queries of one that has more; the same where the model has several groups."""
    key, count = "decoder.query_embedding", len(model.decoder.query_embedding)
    if model.decoder.training_groups > 1 or key not in state or len(state[key]) <= count:
        return state
    return {**state, key: state[key][:count]}


def _whole(start: WarmStart, key: str, tensor: Tensor, initial: Tensor, reason: str) -> Tensor:
    """A tensor of the file if it has the model's shape, or else the model's. reason: for the line of a loaded one."""
    if tensor.shape == initial.shape:
        start.count("loaded", _network_part(key), reason, initial.numel())
        return tensor
    shapes = f"{key}: {_shape(tensor)} and {_shape(initial)}"
    start.count("new", _network_part(key), "another shape in the file", initial.numel(), shapes)
    start.count("unused", _network_part(key), "another shape in the model", tensor.numel())
    return initial


def _network_part(key: str) -> str:
    return key.partition(".")[0]


def named_rows(checkpoint: Checkpoint, model: Network, drives: Drives) -> dict[str, NamedRows]:
    """The tensors of a model that have a row for each class or each camera, by key.

    Rows of classes start from the class of the same name, else from that which `like` states. Camera embeddings start
    from the camera of the same name, else from the nearest view by heading, else, where no heading is known, from the
    mean of all.

    drives: to train on, whose first gives the cameras where their names differ.
    """
    config = model.config
    classes, cameras = _names(checkpoint, config, "classes"), _names(checkpoint, config, "cameras")
    likes = {name: settings.like for name, settings in config.class_settings.items()}
    starts_of_classes = {
        name: next(((label,) for label in (name, likes.get(name, "")) if label in classes), ())
        for name in config.classes
    }
    layers = [
        f"detection_head.class_branches.{branch}.{[*modules.named_children()][-1][0]}"
        for branch, modules in model.detection_head.class_branches.named_children()
    ]
    keys = [f"{layer}.{parameter}" for layer in layers for parameter in ("weight", "bias")]
    rows = dict.fromkeys(keys, NamedRows("class rows", classes, starts_of_classes))
    if model.image_tokens.camera_embedding is not None:
        starts, remark = _views(config.cameras, cameras, drives), "; by heading where it is known; all are trained"
        rows[CAMERA_EMBEDDING] = NamedRows("camera embeddings", cameras, starts, remark)
    return rows


def _names(checkpoint: Checkpoint, config: ModelConfig, what: Literal["classes", "cameras"]) -> tuple[str, ...]:
    """The classes or cameras of a weights file: as it states, or those of the model that it is of; else none."""
    try:
        names = json.loads(checkpoint.facts.get(what, "null"))
    except ValueError:
        names = None
    if isinstance(names, list) and all(isinstance(name, str) for name in names):
        return tuple(names)
    name, models = checkpoint.facts.get("model"), checkpoint.models
    if models and (name is None or name in models):
        return tuple(getattr(load_config(models[0]), what))
    return tuple(getattr(config, what)) if name == config.name else ()


def _views(cameras: tuple[str, ...], source: tuple[str, ...], drives: Drives) -> Starts:
    views: dict[str, str] = {}
    if source and not set(cameras) <= set(source):
        try:
            assigned = assign_cameras(drives.open(0).rig, source)
            views = dict(zip(assigned.cameras, assigned.embeddings, strict=True))
        except InputError:  # no heading is known for the file's cameras
            views = {}
    return {name: (name,) if name in source else (views[name],) if name in views else source for name in cameras}


Normalisation = tuple[tuple[float, float, float], tuple[float, float, float]]  # mean and std of R, G and B
IMAGENET: Normalisation = ((123.675, 116.28, 103.53), (58.395, 57.12, 57.375))
# By a key that a file of this origin has: the origin in words, the kind of its backbone, its usual normalisation.
ORIGINS: Mapping[str, tuple[str, str, Normalisation | None]] = {
    "backbone.conv1.weight": ("bevcli", "", None),
    "layer1.0.conv1.weight": ("torchvision or timm", "resnet", IMAGENET),
    "conv_stem.weight": ("timm", "efficientnet-lite", ((127.5,) * 3, (127.5,) * 3)),
    "_conv_stem.weight": ("efficientnet-lite-pytorch", "efficientnet-lite", ((127.0,) * 3, (128.0,) * 3)),
}
ALMOST = 1.0  # difference of two normalisations, on the scale 0 to 255, that no model notices
# The modules of an inverted residual block, in the order of a block without and with expansion.
TIMM_DEPTHWISE = {"conv_dw": "depthwise", "bn1": "depthwise_norm", "conv_pw": "project", "bn2": "project_norm"}
TIMM = {
    "conv_pw": "expand", "bn1": "expand_norm", "conv_dw": "depthwise", "bn2": "depthwise_norm",
    "conv_pwl": "project", "bn3": "project_norm",
}  # fmt: skip
PYTORCH = {
    "_expand_conv": "expand", "_bn0": "expand_norm", "_depthwise_conv": "depthwise", "_bn1": "depthwise_norm",
    "_project_conv": "project", "_bn2": "project_norm",
}  # fmt: skip


def start_backbone(file: Path, model: Network, model_file: str) -> tuple[WarmStart, tuple[str, ...]]:
    """Load, in place, the whole backbone of a model from a weights file; return what was loaded, and notes.

    Offsets of deformable convolutions, which ImageNet weights lack, keep the model's initial values.

    Args:
        file: a .pth or .safetensors with the key names of `ORIGINS`.
        model: unchanged where the file does not fit.
        model_file: name or TOML file of the model, for the messages.

    Raises WeightsError for a file that cannot be read or has other key names, and for a tensor that does not fit.
    """
    state, config = read_checkpoint(file).state, model.config.backbone
    origin, kind, usual = next((ORIGINS[key] for key in ORIGINS if key in state), ("", "", None))
    if not origin or kind not in ("", config.kind):
        held = f"holds no backbone (expected a tensor named {' or '.join(ORIGINS)})"
        if origin:
            held = f'holds a backbone of kind "{kind}" (key names of {origin}), that of {model_file} is "{config.kind}"'
        raise WeightsError(
            f"{file}: {held}; choose other `backbone_weights` (`--backbone-weights`), or another kind in [backbone]"
        )
    start, model_state = WarmStart(file, "", f"the backbone of {model_file}"), model.backbone.state_dict()
    if origin == "bevcli":
        renamed = {key.removeprefix("backbone."): tensor for key, tensor in state.items()}
    else:
        rename = _of_resnet if kind == "resnet" else _of_blocks(config, origin)
        renamed = {rename(key): tensor for key, tensor in state.items()}
    for key, tensor in model_state.items():
        stage = re.match(r"stages\.(\d+)\.", key)
        part = f"backbone: stage {int(stage[1]) + 1}" if stage else "backbone: stem"
        if key in renamed and renamed[key].shape == tensor.shape:
            start.count("loaded", part, "", tensor.numel())
            model_state[key] = renamed[key]
        elif key not in renamed and ("offset_and_mask" in key or key.endswith(INTEGER_KEY)):
            start.count("new", part, "not in the file", tensor.numel(), key)
        else:
            what = f"has the shape {_shape(renamed[key])}" if key in renamed else "is not there"
            raise WeightsError(
                f"{file}: does not fit the backbone of {model_file}: {key} (expected {_shape(tensor)}) {what}; choose "
                "other `backbone_weights` (`--backbone-weights`), or change [backbone]"
            )
    for key, tensor in renamed.items():
        if key not in model_state:
            start.count("unused", "other parts", "not in the backbone", tensor.numel(), key)
    model.backbone.load_state_dict(model_state)
    return start, tuple(_notes(usual, model.config.image, start))


def _notes(usual: Normalisation | None, image: ImageConfig, start: WarmStart) -> list[str]:
    if usual is None:
        return []
    pairs = zip((*usual[0], *usual[1]), (*image.mean, *image.std), strict=True)
    if image.color_order == "rgb" and all(abs(theirs - ours) <= ALMOST for theirs, ours in pairs):
        return []
    text = f"{start.file}: such weights usually take images with mean {list(usual[0])} and std {list(usual[1])}"
    return [f"{text} in RGB; the model's are {list(image.mean)}, {list(image.std)} in {image.color_order.upper()}"]


def _shape(tensor: Tensor) -> str:
    return " × ".join(map(str, tensor.shape))


def _of_resnet(key: str) -> str:
    return re.sub(r"^layer(\d)\.", lambda match: f"stages.{int(match[1]) - 1}.", key)


def _of_blocks(config: object, origin: str) -> Callable[[str], str]:
    """The function that gives the name, in the backbone, of a key of an EfficientNet-lite."""
    assert isinstance(config, EfficientNetLiteConfig)
    stage_of = [(stage - 1, block) for stage in range(1, 8) for block in range(config.blocks(stage))]

    def of_pytorch(key: str) -> str:
        match = re.match(r"^_blocks\.(\d+)\.(\w+)\.(\w+)$", key)
        if match and int(match[1]) < len(stage_of) and match[2] in PYTORCH:
            stage, block = stage_of[int(match[1])]
            return f"stages.{stage}.{block}.{PYTORCH[match[2]]}.{match[3]}"
        stem = {"_conv_stem": "conv1", "_bn0": "bn1", "_bn1": "head_norm"}
        return re.sub(r"^\w+", lambda name: stem.get(name[0], name[0]), key)

    def of_timm(key: str) -> str:
        match = re.match(r"^blocks\.(\d+)\.(\d+)\.(\w+)\.(\w+)$", key)
        modules = TIMM_DEPTHWISE if match and match[1] == "0" else TIMM
        if match and match[3] in modules:
            return f"stages.{match[1]}.{match[2]}.{modules[match[3]]}.{match[4]}"
        return re.sub(r"^conv_stem\.", "conv1.", key)

    return of_timm if origin == "timm" else of_pytorch
