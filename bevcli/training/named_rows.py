"""Tensors of a model with a row for each class or camera, and the rows of another model that they start from."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

from torch import Tensor

from bevcli.checkpoints import Checkpoint
from bevcli.config import load_config
from bevcli.errors import InputError
from bevcli.geometry.cameras import CameraRig
from bevcli.model.camera_assignment import assign_cameras
from bevcli.model.config import ModelConfig
from bevcli.model.network import CAMERA_EMBEDDING, Network

Starts = Mapping[str, tuple[str, ...]]


@dataclass(frozen=True)
class NamedRows:
    """The names of a tensor's rows.

    Attributes:
        part: the rows in words.
        names: of the model's rows.
        source: of the file's rows; empty if the file does not name them.
        starts: the rows of the file that each row of the model starts from, as their mean; none for a new one.
        remark: on rows that start from one of another name.
    """

    part: str
    names: tuple[str, ...]
    source: tuple[str, ...]
    starts: Starts
    remark: str = ""

    def fit(self, found: Tensor, own: Tensor) -> bool:
        """The file names the rows of its tensor, and they have the size of the model's."""
        return len(found) == len(self.source) and found.shape[1:] == own.shape[1:]

    def filled(self, found: Tensor, own: Tensor) -> Tensor:
        """The model's tensor, with the rows that the file has for its names."""
        filled = own.clone()
        for index, name in enumerate(self.names):
            if self.starts[name]:
                filled[index] = found[[self.source.index(each) for each in self.starts[name]]].float().mean(0)
        return filled

    @property
    def loaded(self) -> tuple[str, ...]:
        """Rows of the model that start from rows of the file."""
        return tuple(name for name in self.names if self.starts[name])

    @property
    def new(self) -> tuple[str, ...]:
        """Rows of the model that keep their initial values."""
        return tuple(name for name in self.names if not self.starts[name])

    @property
    def unused(self) -> tuple[str, ...]:
        """Rows of the file that no row starts from."""
        taken = {each for starts in self.starts.values() for each in starts}
        return tuple(name for name in self.source if name not in taken)

    def origins(self) -> str:
        """The loaded rows in words: each with the row that it starts from, if that has another name."""
        texts = [name if self.starts[name] == (name,) else f"{name} from {self._origin(name)}" for name in self.loaded]
        renamed = any(self.starts[name] != (name,) for name in self.loaded)
        return ", ".join(texts) + (self.remark if renamed else "")

    def _origin(self, name: str) -> str:
        return self.starts[name][0] if len(self.starts[name]) == 1 else "the mean of all"


def named_rows(checkpoint: Checkpoint, model: Network, rig: Callable[[], CameraRig]) -> dict[str, NamedRows]:
    """The tensors of a model that have a row for each class or each camera, by key.

    Rows of classes start from the class of the same name, else from that which `like` states. Camera embeddings start
    from the camera of the same name, else from the nearest view by heading, else, where no heading is known, from the
    mean of all.

    rig: gives the cameras of a drive to train on; called where names of cameras differ.
    """
    config = model.config
    classes, cameras = _names(checkpoint, config, "classes"), _names(checkpoint, config, "cameras")
    rows = dict.fromkeys(model.class_keys, NamedRows("class rows", config.classes, classes, _likes(config, classes)))
    if model.image_tokens.camera_embedding is not None:
        starts, remark = _views(config.cameras, cameras, rig), "; by heading where it is known; all are trained"
        rows[CAMERA_EMBEDDING] = NamedRows("camera embeddings", config.cameras, cameras, starts, remark)
    return rows


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
