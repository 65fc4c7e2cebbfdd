"""The demo model: small enough to be part of the package, with every part of BEVFormer."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from bevcli.checkpoints import bundled_weights
from bevcli.config import load_config
from bevcli.errors import WeightsError
from bevcli.frame import Drive
from bevcli.inference.load import load_model
from bevcli.inference.runner import Runner
from bevcli.model.bevformer import BEVFormer
from bevcli.sequences.open import select_range
from bevcli.workshop.synth.drives import FolderDrives
from bevcli.workshop.training.validation import score_drives

STREET = Path(__file__).parents[2] / "samples" / "street"


def test_the_demo_model_is_as_small_as_the_model_card_states() -> None:
    with torch.device("meta"):
        model = BEVFormer(load_config("demo"))
    assert sum(parameter.numel() for parameter in model.parameters()) == pytest.approx(2.5e6, abs=0.05e6)
    assert bundled_weights("demo").stat().st_size == pytest.approx(5.1e6, abs=0.05e6)


def test_photographs_is_demo_with_the_eyes_of_a_detector() -> None:
    demo, photographs = load_config("demo"), load_config("photographs")
    changed = "name", "image", "backbone_scale", "image_detector", "hybrid_queries", "training_rigs"
    assert replace(photographs, **{name: getattr(demo, name) for name in changed}) == demo
    assert photographs.image_classes
    assert bundled_weights("photographs").stat().st_size < 14e6
    assert load_model("photographs", device="cpu").bundled


def test_its_weights_are_in_the_package() -> None:
    loaded = load_model("demo")
    assert loaded.weights == bundled_weights("demo")
    assert loaded.bundled
    of_a_file = load_model(None, bundled_weights("demo"))  # they name their model
    assert (of_a_file.name, of_a_file.bundled) == ("demo", False)


def test_a_users_model_file_does_not_get_the_packages_weights(tmp_path: Path) -> None:
    own = tmp_path / "demo.toml"
    own.write_text((STREET.parents[1] / "configs" / "demo.toml").read_text())
    with pytest.raises(WeightsError, match="has no weights"):
        load_model(str(own))


class FourFrames(FolderDrives):
    def open(self, index: int) -> Drive:
        return select_range(super().open(index), slice(0, 4))


def test_it_finds_cars_and_road_in_the_sample_street() -> None:
    """Thresholds far below the model card's scores, but far above those of random weights."""
    model = load_model("demo", device="cpu")
    drives = FourFrames([STREET], model.config)
    scores = score_drives(Runner(model.prepared, model.device, tracker=model.tracker), drives)
    assert scores.detection.overall.classes["car"].mean_ap > 0.2
    assert scores.segmentation.iou["drivable_road"] > 0.6
    cars = scores.tracking.classes["car"].metrics
    assert cars["amota"] > 0.5
    assert cars["ids"] < 0.02 * cars["gt"]
