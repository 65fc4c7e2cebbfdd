"""Checkpoints of a training. A file is written under a temporary name and renamed: a kill leaves the old one intact."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path

import safetensors.torch
import torch
from torch import Tensor, nn

from bevcli.errors import OutputError, WeightsError
from bevcli.model.bevformer import BEVFormerBase
from bevcli.parsing.pth import read_pth
from bevcli.pipeline.training_rigs import weights_facts

FORMAT = "bevcli-training/1"
# What PyTorch raises for contents that belong to another model.
_DAMAGE = (RuntimeError, ValueError, LookupError, TypeError, AttributeError, OverflowError)


def save_checkpoint(
    path: Path,
    step: int,
    trained: nn.Module,
    optimizer: torch.optim.AdamW,
    average: Mapping[str, Tensor] | None = None,
) -> None:
    """Writes what is needed to resume after `step` steps. Random numbers are drawn from seed and step, not stored.

    Args:
        trained: the model and its auxiliary heads.
        average: the running average of the model's weights, None without one.
    """
    contents = {"format": FORMAT, "step": step, "model": trained.state_dict(), "optimizer": optimizer.state_dict()}
    if average is not None:
        contents["average"] = dict(average)
    replace_file(path, lambda unfinished: torch.save(contents, unfinished))


def load_checkpoint(
    path: Path, trained: nn.Module, optimizer: torch.optim.AdamW, average: dict[str, Tensor] | None = None
) -> int:
    """Restores model, auxiliary heads, optimizer and, in place, the running average of the weights.

    Returns the number of steps done. Raises WeightsError.
    """
    if not path.exists():
        raise WeightsError(f"{path}: no checkpoint to resume from; leave out --resume to start a training")
    file = read_pth(path)
    if file.left_out:
        raise WeightsError(f"{path}: is not a checkpoint of this model: it holds objects ({file.left_out[0]:.100})")
    try:
        contents = file.with_tensors()
        if contents["format"] != FORMAT:
            raise WeightsError(f'{path}: "format" must be "{FORMAT}", found {contents["format"]!r}')
        if any(key.startswith("picture_reader.") for key in contents["model"]):
            raise WeightsError(
                f"{path}: was written by an earlier version, with [training.picture_loss], and cannot be resumed; "
                f"start a new training with --weights {path.with_name('weights.safetensors')} and another --out"
            )
        trained.load_state_dict(contents["model"])
        optimizer.load_state_dict(contents["optimizer"])
        for key, value in {} if average is None else average.items():
            value.copy_(contents["average"][key])
        return int(contents["step"])
    except _DAMAGE as error:
        reason = " ".join(line.strip() for line in str(error).split("\n")[:2])
        raise WeightsError(f"{path}: is not a checkpoint of this model: {reason}") from error


def save_weights(path: Path, model: BEVFormerBase, dtype: torch.dtype) -> None:
    """Writes the model's weights as .safetensors, for `bevcli run --weights`, with the frame and rigs they expect."""
    state = {
        key: (tensor.to(dtype) if tensor.is_floating_point() else tensor).contiguous().cpu()
        for key, tensor in model.state_dict().items()
    }
    replace_file(path, lambda unfinished: safetensors.torch.save_file(state, unfinished, weights_facts(model.config)))


def replace_file(path: Path, write: Callable[[Path], object]) -> None:
    """Writes a file under a temporary name beside `path`, then renames it. Raises OutputError.

    Args:
        write: called with the temporary path.
    """
    unfinished = path.with_name(f"{path.name}.unfinished")
    try:
        write(unfinished)
        os.replace(unfinished, path)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror})") from None
