"""Checkpoints of a training, which a kill at any time cannot spoil: written aside, then renamed."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import safetensors.torch
import torch
from torch import nn

from bevcli.errors import OutputError, WeightsError
from bevcli.model.bevformer import BEVFormer

FORMAT = "bevcli-training/1"


def save_checkpoint(path: Path, step: int, model: nn.Module, optimizer: torch.optim.AdamW) -> None:
    """All that goes on from `step` steps done needs: chance is drawn anew from seed and step.

    model: the whole of what learns.
    """
    contents = {"format": FORMAT, "step": step, "model": model.state_dict(), "optimizer": optimizer.state_dict()}
    _replace(path, lambda aside: torch.save(contents, aside))


def load_checkpoint(path: Path, model: nn.Module, optimizer: torch.optim.AdamW) -> int:
    """Puts model and optimizer where they were; returns the steps done. Raises WeightsError."""
    try:
        contents = torch.load(path, map_location="cpu", weights_only=True)
        if contents["format"] != FORMAT:
            raise WeightsError(f'{path}: "format" must be "{FORMAT}", found {contents["format"]!r}')
        model.load_state_dict(contents["model"])
        optimizer.load_state_dict(contents["optimizer"])
        return int(contents["step"])
    except FileNotFoundError:
        raise WeightsError(f"{path}: no checkpoint to resume from; leave out --resume to begin") from None
    except (RuntimeError, ValueError, KeyError, TypeError, EOFError) as error:
        reason = str(error).split("\n")[0]
        raise WeightsError(f"{path}: is no checkpoint of this model: {reason}") from error


def save_weights(path: Path, model: BEVFormer, dtype: torch.dtype) -> None:
    """The model's weights as .safetensors, for `bevcli run --weights`."""
    state = {
        key: (tensor.to(dtype) if tensor.is_floating_point() else tensor).contiguous().cpu()
        for key, tensor in model.state_dict().items()
    }
    _replace(path, lambda aside: safetensors.torch.save_file(state, aside, {"model": model.config.name}))


def _replace(path: Path, write: Callable[[Path], object]) -> None:
    aside = path.with_name(f"{path.name}.unfinished")
    try:
        write(aside)
        os.replace(aside, path)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror})") from None
