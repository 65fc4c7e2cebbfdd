"""A configured model with its weights, on the device that the user wants."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from bevcli.checkpoints import bundled_weights, inspect, load_weights
from bevcli.config import known_models, load_config
from bevcli.errors import BevcliError, WeightsError
from bevcli.model.bevformer import BEVFormer, BEVFormerConfig
from bevcli.model.prepared import Precision

DEFAULT_MODEL = "demo"
UNTRAINED_SEED = 0  # so that two untrained runs of one drive agree


@dataclass(frozen=True)
class LoadedModel:
    """weights: the file they came from, None when untrained. bundled: whether that file is the package's own."""

    model: BEVFormer
    weights: Path | None
    bundled: bool = False

    @property
    def config(self) -> BEVFormerConfig:
        """The model's configuration."""
        return self.model.config

    @property
    def untrained(self) -> bool:
        """Whether the weights are random: then nothing that the model says means anything."""
        return self.weights is None


def load_model(name_or_path: str | None, weights: Path | None, *, untrained: bool) -> LoadedModel:
    """The model of a known name or TOML file, with a file of weights or, if the user says so, with none.

    name_or_path: None takes the model that the weights fit, or without weights the package's own.
    Raises ConfigError or WeightsError, the latter also when there are no weights and `untrained` is not given.
    """
    if weights is not None and untrained:
        raise WeightsError(f"--weights {weights} and --untrained exclude each other: give one of them")
    if name_or_path is None:
        name_or_path = DEFAULT_MODEL if weights is None else _model_of(weights)
    config = load_config(name_or_path)
    bundled = bundled_weights(name_or_path) if weights is None and not untrained else None
    file = weights or bundled
    if file is None and not untrained:
        raise WeightsError(
            f"model {config.name} has no weights: give --weights FILE (the official .pth or a .safetensors), "
            "or say --untrained to see the machinery run on random weights"
        )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(UNTRAINED_SEED)
        model = BEVFormer(config)
    if file is not None:
        load_weights(file, model)
    return LoadedModel(model, file, bundled=bundled is not None)


def _model_of(weights: Path) -> str:
    """The first known model that a file of weights fits."""
    models = inspect(weights).models
    if not models:
        raise WeightsError(
            f"{weights}: fits none of the known models ({', '.join(known_models())}): name its own by --model FILE.toml"
        )
    return models[0]


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
