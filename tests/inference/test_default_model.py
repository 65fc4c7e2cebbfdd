"""The model of the package that is taken where none is named: by whether bevcli rendered the drives."""

import json
import shutil
from pathlib import Path

import pytest
from command_line import command

import bevcli
from bevcli.errors import InputError
from bevcli.inference import ModelOptions
from bevcli.inference.load import choose_model, default_model

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
