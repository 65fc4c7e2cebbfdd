"""Files of weights: the official .pth and our .safetensors, to the state dict of our model."""

from __future__ import annotations

import pickle
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from bevcli.config import known_models, load_config
from bevcli.errors import WeightsError
from bevcli.model.bevformer import BEVFormer, BEVFormerConfig
from bevcli.model.official_keys import from_official, is_official

# What torch's restricted unpickler raises on bytes that are no pickle, depending on where they go wrong.
_BROKEN_PICKLE = (
    pickle.UnpicklingError, RuntimeError, OSError, EOFError, ValueError, LookupError, TypeError, AttributeError,
    struct.error,
)  # fmt: skip


@dataclass(frozen=True)
class KeyReport:
    """How a state dict differs from what a model needs; all empty when it fits.

    misshapen: lines "key: expected (…), found (…)".
    """

    missing: tuple[str, ...]
    unexpected: tuple[str, ...]
    misshapen: tuple[str, ...]

    @property
    def fits(self) -> bool:
        """Whether nothing differs."""
        return not (self.missing or self.unexpected or self.misshapen)

    def describe(self) -> str:
        """Every differing key, on one line."""
        parts = [("missing", self.missing), ("unexpected", self.unexpected), ("misshapen", self.misshapen)]
        return "; ".join(f"{len(keys)} {name}: {', '.join(keys)}" for name, keys in parts if keys)


@dataclass(frozen=True)
class Checkpoint:
    """A file of weights, read. state: under our names. official: whether the file uses the original's names.

    facts: what the file says about itself, such as its epoch.
    """

    path: Path
    state: Mapping[str, Tensor]
    official: bool
    facts: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class CheckpointSummary:
    """What a file of weights is.

    models: those of ours that it fits. parameters: how many numbers it holds, running statistics included.
    """

    path: Path
    models: tuple[str, ...]
    official: bool
    tensors: int
    parameters: int
    file_bytes: int
    facts: Mapping[str, str]


def load_weights(path: Path, model: BEVFormer, *, resample: bool = False) -> Checkpoint:
    """Loads a file of weights into a model, in place; every key must be there, none more, all of the right shape.

    resample: weights of a BEV grid with another number of cells are interpolated, to be fine-tuned.

    Raises WeightsError that says which known model the file is for, or else lists every key that differs.
    """
    checkpoint = read_checkpoint(path)
    if resample:
        checkpoint = replace(checkpoint, state=model.bev_queries.resampled(checkpoint.state, "bev_queries."))
    report = compare(checkpoint.state, model.state_dict())
    if not report.fits:
        name, others = model.config.name, fitting_models(checkpoint.state)
        if others:
            raise WeightsError(f"{path}: expected weights of model {name}, found those of {' or '.join(others)}")
        raise WeightsError(f"{path}: does not fit model {name} nor any known one; {report.describe()}")
    model.load_state_dict(dict(checkpoint.state))
    return checkpoint


def convert(source: Path, destination: Path) -> CheckpointSummary:
    """Writes a file of weights as .safetensors under our names, once it fits one of the known models."""
    checkpoint = read_checkpoint(source)
    models = fitting_models(checkpoint.state)
    if not models:
        raise WeightsError(f"{source}: fits none of the known models ({', '.join(known_models())})")
    if destination.suffix != ".safetensors":
        raise WeightsError(f"{destination}: expected a name that ends in .safetensors")
    tensors = {key: tensor.contiguous() for key, tensor in checkpoint.state.items()}
    safetensors.torch.save_file(tensors, destination, {**checkpoint.facts, "model": models[0]})
    return inspect(destination)


def inspect(path: Path) -> CheckpointSummary:
    """What a file of weights is."""
    checkpoint = read_checkpoint(path)
    return CheckpointSummary(
        path=path,
        models=fitting_models(checkpoint.state),
        official=checkpoint.official,
        tensors=len(checkpoint.state),
        parameters=sum(tensor.numel() for tensor in checkpoint.state.values()),
        file_bytes=path.stat().st_size,
        facts=checkpoint.facts,
    )


def read_checkpoint(path: Path) -> Checkpoint:
    """Reads an official .pth or a .safetensors, official keys or ours. Nothing but tensors is unpickled."""
    if not path.is_file():
        raise WeightsError(f"{path}: no such file of weights")
    state, facts = _read_safetensors(path) if path.suffix == ".safetensors" else _read_pth(path)
    official = is_official(state)
    return Checkpoint(path, from_official(state) if official else state, official, facts)


def bundled_weights(model: str) -> Path | None:
    """The file of weights that comes with the package for a known model; None where there is none."""
    file = Path(str(resources.files("bevcli").joinpath("weights", f"{model}.safetensors")))
    return file if model in known_models() and file.is_file() else None


def compare(state: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> KeyReport:
    """Which keys of a state dict are missing, unexpected or misshapen against a model's."""
    shapes = {key: tuple(tensor.shape) for key, tensor in expected.items()}
    found = {key: tuple(tensor.shape) for key, tensor in state.items()}
    return KeyReport(
        missing=tuple(key for key in shapes if key not in found),
        unexpected=tuple(key for key in found if key not in shapes),
        misshapen=tuple(
            f"{key}: expected {shapes[key]}, found {found[key]}"
            for key in shapes
            if key in found and shapes[key] != found[key]
        ),
    )


def fitting_models(state: Mapping[str, Tensor]) -> tuple[str, ...]:
    """The known models that a state dict fits."""
    return tuple(name for name in known_models() if compare(state, expected_state(load_config(name))).fits)


def expected_state(config: BEVFormerConfig) -> dict[str, Tensor]:
    """The state dict that a model needs, as tensors without contents."""
    with torch.device("meta"):
        return BEVFormer(config).state_dict()


def _read_safetensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            state = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
            return state, dict(file.metadata() or {})
    except safetensors.SafetensorError as error:
        raise WeightsError(f"{path}: is no safetensors file: {error}") from error


def _read_pth(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    try:
        contents = torch.load(path, map_location="cpu", weights_only=True)
    except _BROKEN_PICKLE as error:
        raise WeightsError(
            f"{path}: is no file of weights that is safe to read (expected a PyTorch file of tensors and plain values, "
            "or .safetensors): it is damaged, something else, or holds objects that could run code"
        ) from error
    state = contents.get("state_dict", contents) if isinstance(contents, dict) else None
    if not isinstance(state, dict) or not state or not all(isinstance(v, Tensor) for v in state.values()):
        raise WeightsError(f"{path}: holds no state dict; expected tensors by name, at the top or as state_dict")
    meta = contents.get("meta")
    facts = {} if not isinstance(meta, dict) else {k: str(meta[k]) for k in ("epoch", "iter", "time") if k in meta}
    return state, facts
