"""demo.toml: a model small enough to come with the package, with every part of BEVFormer."""

from __future__ import annotations

import torch

from bevcli.config import load_config, load_training
from bevcli.model.bevformer import BEVFormer
from bevcli.training.trainer import TrainingConfig


def test_the_demo_model_is_small_and_whole() -> None:
    config = load_config("demo")
    with torch.device("meta"):
        state = BEVFormer(config).state_dict()
    numbers = sum(tensor.numel() for tensor in state.values())
    assert numbers <= 10e6
    assert 2 * numbers <= 20e6  # bytes in float16
    assert config.heads == ("detection", "segmentation")
    assert (config.ego_motion.can_bus, config.ego_motion.shift, config.ego_motion.rotation) == (True, True, True)


def test_the_demo_model_trains_with_history() -> None:
    settings = load_training("demo", TrainingConfig)
    assert settings.clips.frames >= 2
    assert settings.held_out > 0
    assert settings.weights_dtype == "float16"
