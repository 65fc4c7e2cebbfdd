"""A configured model with its weights, on the device that the user wants."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from bevcli.checkpoints import load_weights
from bevcli.config import load_config
from bevcli.errors import BevcliError, WeightsError
from bevcli.model.bevformer import BEVFormer
from bevcli.model.inference import Precision

UNTRAINED_SEED = 0  # so that two untrained runs of one drive agree


@dataclass(frozen=True)
class LoadedModel:
    """weights: the file they came from, None when untrained."""

    model: BEVFormer
    weights: Path | None

    @property
    def untrained(self) -> bool:
        """Whether the weights are random: then nothing that the model says means anything."""
        return self.weights is None


def load_model(name_or_path: str, weights: Path | None, *, untrained: bool) -> LoadedModel:
    """The model of a known name or TOML file, with a file of weights or, if the user says so, with none.

    Raises ConfigError or WeightsError, the latter also when neither weights nor `untrained` is given, or both.
    """
    config = load_config(name_or_path)
    if weights is not None and untrained:
        raise WeightsError(f"--weights {weights} and --untrained exclude each other: give one of them")
    if weights is None and not untrained:
        raise WeightsError(
            f"model {config.name} has no weights: give --weights FILE (the official .pth or a .safetensors), "
            "or say --untrained to see the machinery run on random weights"
        )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(UNTRAINED_SEED)
        model = BEVFormer(config)
    if weights is not None:
        load_weights(weights, model)
    return LoadedModel(model, weights)


def choose_device(name: str) -> torch.device:
    """ "auto", "cpu" or "cuda" -> the device; auto takes a GPU where there is one."""
    available = torch.cuda.is_available()
    if name == "cuda" and not available:
        raise BevcliError(
            "--device cuda: PyTorch sees no CUDA GPU here (use --device cpu, or install a CUDA build of torch)"
        )
    return torch.device("cuda" if available and name != "cpu" else "cpu")


def choose_precision(chosen: Precision | None, device: torch.device) -> Precision:
    """The user's choice, or fp32 on the CPU and bf16 on a GPU."""
    if chosen is not None:
        return chosen
    return "bf16" if device.type == "cuda" else "fp32"
