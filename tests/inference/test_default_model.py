"""The demo model, the model that fits a drive where none is named, and a rig compared with the training's."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import safetensors
import torch
from command_line import command
from memory_drive import MemoryDrive, make_camera, make_rig

import bevcli
from bevcli.checkpoints import bundled_weights
from bevcli.config import load_config
from bevcli.errors import InputError, WeightsError
from bevcli.frame import Drive
from bevcli.geometry.cameras import CameraRig, default_ego_from_bev, level_rig
from bevcli.geometry.transforms import Array, rigid
from bevcli.inference import ModelOptions
from bevcli.inference.load import choose_model, default_model, load_model
from bevcli.inference.runner import Runner
from bevcli.model.bevformer import BEVFormer
from bevcli.model.config import BevFrameConfig, facts_notes, training_rig_notes, weights_facts
from bevcli.model.temporal_model import build_model
from bevcli.sequences.open import select_range
from bevcli.workshop.synth.drives import FolderDrives
from bevcli.workshop.synth.rig import nuscenes_like_rig
from bevcli.workshop.training.validation import score_drives

SAMPLES = Path(__file__).parents[2] / "samples"
STREET = SAMPLES / "street"


def stop(options: ModelOptions) -> None:
    """In place of `load_model`: ends a command with the name of its model."""
    raise InputError(str(options.model))


@pytest.fixture
def real(tmp_path):
    """The sample drive without the statement that it was rendered."""
    folder = tmp_path / "real"
    shutil.copytree(STREET, folder)
    document = json.loads((folder / "calibration.json").read_text())
    del document["rendered"]
    (folder / "calibration.json").write_text(json.dumps(document))
    return folder


def test_demo_is_for_drives_that_are_all_rendered(real):
    assert default_model([STREET]) == "demo"
    assert default_model([STREET, str(SAMPLES / "crossing")]) == "demo"
    assert default_model([STREET, real]) == "photographs"
    assert default_model([]) == "photographs"


def test_what_cannot_be_read_counts_as_photographs(tmp_path, real):
    (real / "calibration.json").write_text("{")
    (tmp_path / "dash.mp4").touch()
    others = (real, tmp_path / "dash.mp4", tmp_path / "missing", "s3://bucket/fleet/7", "a\0b")
    assert {default_model([drive]) for drive in others} == {"photographs"}


@pytest.mark.parametrize("named", [ModelOptions(model="tiny"), ModelOptions(weights=Path("mine.safetensors"))])
def test_a_named_model_or_file_of_weights_overrules_it(named, real):
    assert choose_model(named, [real]) == (named, ())


def test_only_photographs_is_said(real):
    options, notes = choose_model(ModelOptions(), [real])
    assert options.model == "photographs"
    assert notes == ("model photographs, as the drive is no rendering of bevcli: `model` (`--model`) chooses another",)
    assert choose_model(ModelOptions(), [STREET])[1] == ()
    assert choose_model(ModelOptions(), None)[0].model == "demo"
    assert "not all drives are" in choose_model(ModelOptions(), [STREET, real])[1][0]


def test_a_run_chooses_it_by_its_drive(real, tmp_path):
    done = command(tmp_path, "run", str(real), "--frames", "0:1", "--untrained")
    assert done.returncode == 0, done.stderr
    assert "note: model photographs, as the drive is no rendering of bevcli" in done.stderr
    assert json.loads((tmp_path / "runs/real-photographs/summary.json").read_text())["model"] == "photographs"


@pytest.mark.parametrize("data", [{"data": STREET}, {"rendered": (1_000_000,)}])
def test_a_validation_of_rendered_drives_takes_demo(data, monkeypatch):
    monkeypatch.setattr("bevcli.workshop.training.trainer.load_model", stop)
    with pytest.raises(InputError, match=r"^demo$"):
        bevcli.validate(**data)


def test_a_batch_takes_the_model_that_suits_all_its_drives(real, tmp_path, monkeypatch):
    monkeypatch.setattr("bevcli.workshop.batch.batch.load_model", stop)
    shutil.copytree(STREET, tmp_path / "street")
    for drives, model in (("st*", "demo"), ("real", "photographs"), ("[rs]*", "photographs")):
        with pytest.raises(InputError, match=rf"^{model}$"):
            bevcli.batch(tmp_path / drives, tmp_path / "out")


def tilted(degrees: float, height_m: float = 1.84) -> Array:
    """The default bev frame, tilted about its x axis."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    given = default_ego_from_bev()
    given[2, 3] = height_m
    return given @ rigid((0, 0, 0), [[1, 0, 0], [0, c, -s], [0, s, c]])


def with_bev_frame(ego_from_bev: Array) -> CameraRig:
    return replace(nuscenes_like_rig(), ego_from_bev=ego_from_bev)


def test_the_rig_of_the_training_needs_no_note():
    assert training_rig_notes(nuscenes_like_rig(), load_config("demo")) == ()


def test_unlike_cameras_are_told_on_one_line_with_the_cost():
    rig = nuscenes_like_rig()
    higher = [replace(c, ego_from_camera=rigid((0, 0, 2.0)) @ c.ego_from_camera) for c in rig.cameras]
    (note,) = training_rig_notes(CameraRig(tuple(higher), rig.ego_from_bev), load_config("demo"))
    assert "camera heights 3.5 to 3.6 m (0.8 to 2.8 m)" in note
    assert "; measured: mAP" in note
    assert "\n" not in note
    three = [replace(make_camera(f"C{k}", 120.0 * k), name=f"C{k}") for k in range(3)]
    (note,) = training_rig_notes(CameraRig(tuple(three), rig.ego_from_bev), load_config("demo"))
    assert "3 cameras (4 to 8)" in note


def test_a_tilted_bev_frame_is_told_by_what_the_weights_expect():
    (note,) = training_rig_notes(with_bev_frame(tilted(2.7)), load_config("demo"))
    assert "tilted by 2.7° and 1.84 m high, but the weights expect a level one at 1.84 m" in note
    assert training_rig_notes(with_bev_frame(tilted(2.7)), load_config("tiny")) == ()
    (note,) = training_rig_notes(with_bev_frame(tilted(5)), load_config("tiny"))
    assert "boxes 30 m away may be 2.6 m too high or too low" in note


def test_a_bev_frame_is_levelled_with_its_heading_and_origin():
    rig = with_bev_frame(tilted(2.0, height_m=0.3))
    level = level_rig(rig, 1.84).ego_from_bev
    np.testing.assert_allclose(level, default_ego_from_bev(), atol=1e-9)
    assert level_rig(nuscenes_like_rig(), 1.84).ego_from_bev is not level
    own = nuscenes_like_rig()
    assert level_rig(own, 1.84) is own


@pytest.mark.parametrize("ego_from_bev", [tilted(2.7), tilted(-1.5, height_m=0.0)], ids=["tilted", "on the ground"])
def test_boxes_in_ego_do_not_depend_on_the_drives_bev_frame(mini_config, ego_from_bev):
    """A model that expects a level frame predicts the same boxes whatever frame the calibration states."""
    config = replace(mini_config, bev_frame=BevFrameConfig(level=True, height_m=1.84))
    torch.manual_seed(0)
    runner = Runner(build_model(config), torch.device("cpu"))
    found = []
    for frame_of_drive in (default_ego_from_bev(), ego_from_bev):
        drive = MemoryDrive(2, rig=replace(make_rig(), ego_from_bev=frame_of_drive))
        results = [prediction for _, prediction, _ in runner.run(drive, range(2))]
        found.append(results[-1].boxes_ego)
    np.testing.assert_allclose(found[0].centers, found[1].centers, atol=1e-4)
    np.testing.assert_allclose(found[0].yaws, found[1].yaws, atol=1e-4)


def test_the_models_own_weights_state_what_they_expect():
    file = bundled_weights("demo")
    assert file is not None
    with safetensors.safe_open(Path(file), framework="pt") as weights:
        facts = weights.metadata()
    assert facts.items() <= weights_facts(load_config("demo")).items()
    assert facts["bev_frame"] == "level, 1.84 m above the ground"


def test_weights_of_another_bev_frame_than_the_models_are_told():
    assert not list(facts_notes(weights_facts(load_config("demo")), load_config("demo")))
    assert not list(facts_notes({}, load_config("tiny")))
    (note,) = facts_notes(weights_facts(load_config("demo")), load_config("tiny"))
    assert 'trained with a bev frame "level, 1.84 m above the ground"' in note


def test_the_demo_model_is_as_small_as_the_model_card_states() -> None:
    with torch.device("meta"):
        model = BEVFormer(load_config("demo"))
    assert sum(parameter.numel() for parameter in model.parameters()) == pytest.approx(2.76e6, abs=0.05e6)
    assert bundled_weights("demo").stat().st_size == pytest.approx(5.6e6, abs=0.05e6)


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
    own.write_text((SAMPLES.parent / "configs" / "demo.toml").read_text())
    with pytest.raises(WeightsError, match="has no weights"):
        load_model(str(own))


class FourFrames(FolderDrives):
    def open(self, index: int) -> Drive:
        return select_range(super().open(index), slice(0, 4))


def test_it_finds_cars_and_road_in_the_sample_street() -> None:
    """Thresholds far below the model card's scores, but far above those of random weights."""
    model = load_model("demo", device="cpu")
    drives = FourFrames([SAMPLES / "street"], model.config)
    scores = score_drives(Runner(model.prepared, model.device, tracker=model.tracker), drives)
    assert scores.detection.overall.classes["car"].mean_ap > 0.2
    assert scores.segmentation.iou["drivable_road"] > 0.6
    cars = scores.tracking.classes["car"].metrics
    assert cars["amota"] > 0.5
    assert cars["ids"] < 0.02 * cars["gt"]
