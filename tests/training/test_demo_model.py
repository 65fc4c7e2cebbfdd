"""demo.toml: a model small enough to come with the package, with every part of BEVFormer."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from bevcli.checkpoints import bundled_weights
from bevcli.config import TRAINING, load_config, load_table
from bevcli.errors import WeightsError
from bevcli.model.bevformer import BEVFormer
from bevcli.model.prepared import prepare_for_inference
from bevcli.pipeline.model_loading import load_model
from bevcli.pipeline.runner import Runner
from bevcli.training.drives import FolderDrives
from bevcli.training.trainer import TrainingConfig
from bevcli.training.validation import validate

STREET = Path(__file__).parents[2] / "samples" / "street"


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
    settings = load_table("demo", TRAINING, TrainingConfig)
    assert settings.clips.frames >= 2
    assert settings.held_out > 0
    assert settings.weights_dtype == "float16"


def test_its_weights_come_with_the_package_and_are_the_default() -> None:
    loaded = load_model()
    assert loaded.name == "demo"
    assert loaded.weights == bundled_weights("demo")
    assert loaded.bundled
    assert loaded.weights.stat().st_size <= 20e6


@pytest.mark.parametrize("name", ["tiny", "small", "base"])
def test_other_models_refuse_to_run_without_weights(name: str) -> None:
    with pytest.raises(WeightsError, match=f"model {name} has no weights: give --weights FILE"):
        load_model(name)


def test_a_file_of_the_users_own_does_not_get_the_packages_weights(tmp_path: Path) -> None:
    own = tmp_path / "demo.toml"
    own.write_text((STREET.parents[1] / "configs" / "demo.toml").read_text())
    with pytest.raises(WeightsError, match="has no weights"):
        load_model(str(own))


def test_weights_alone_say_which_model_they_are_for() -> None:
    loaded = load_model(None, bundled_weights("demo"))
    assert loaded.name == "demo"
    assert not loaded.bundled


def test_it_sees_the_street_in_the_samples() -> None:
    """Far below what the model card states: enough to tell weights from noise."""
    model = load_model().network
    cpu = torch.device("cpu")
    scores = validate(Runner(prepare_for_inference(model, cpu), cpu), FolderDrives([STREET], 2.0))
    assert scores.detection.overall.classes["car"].mean_ap > 0.2
    assert scores.segmentation.iou["drivable_road"] > 0.6
