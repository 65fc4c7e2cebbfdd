"""An exported BEVFormerV2 computes what the model computes, over whole drives: its window is that of the model."""

import json
from dataclasses import replace
from importlib import resources
from pathlib import Path

import original_reference as original
import pytest
import torch
from command_line import invoked
from interrupted import run_frames
from memory_drive import WithoutImages

from bevcli.config import load_config
from bevcli.errors import BevcliError
from bevcli.inference.load import Model, load_model
from bevcli.model.config import ImageConfig
from bevcli.model.temporal_model import build_model
from bevcli.registry import entries
from bevcli.runs.run_into_folder import run_into_folder
from bevcli.sequences.open import open_sequence
from bevcli.workshop.bevformer_v2 import BEVFormerV2
from bevcli.workshop.engines.export_onnx import calibration_images, export_onnx, quantize
from bevcli.workshop.engines.exported import FrameDifference, check_exported

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")
pytest.importorskip("openvino")
STREET = Path(__file__).parents[2] / "samples" / "street"
CROPPED = ImageConfig((160, 90), (123.0, 116.0, 103.0), (58.0, 57.0, 57.0), "rgb", crop=(8, 20, 152, 90))
WINDOW = (-3, -1, 0)
# First frames, a change of scene inside the window, cameras without an image, and a frame without any.
DRIVE = WithoutImages({1: ["CAM_BACK"], 4: ["CAM_FRONT"], 6: "all"}, count=8, scenes="aaabbbbb")


@pytest.fixture(scope="module")
def cropping_model(window_model):
    """A function: frames of the window -> a small BEVFormerV2 that crops its images."""

    def make(*frames: int) -> BEVFormerV2:
        model = window_model(*frames)
        other = BEVFormerV2(replace(model.config, image=CROPPED)).eval()
        other.load_state_dict(model.state_dict())
        return other

    return make


@pytest.fixture(scope="module")
def window_file(cropping_model, tmp_path_factory):
    """A function: frames of the window -> the file of that model, exported when it is first asked for."""
    folder = tmp_path_factory.mktemp("windows")

    def file_of(frames: tuple[int, ...] = WINDOW) -> Path:
        file = folder / f"window-of-{len(frames)}.onnx"
        if not file.exists():
            export_onnx(cropping_model(*frames), file, decode=True, untrained=True)
        return file

    return file_of


def agree(differences: list[FrameDifference], frames: int, logits: float = 1e-3) -> None:
    assert len(differences) == frames
    assert max(row.logits for row in differences) < logits
    assert max(row.box_m for row in differences) < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("engine", list(entries("bevcli.engines")))
@pytest.mark.parametrize("frames", [(0,), WINDOW])
def test_a_file_equals_the_model_over_a_drive(cropping_model, window_file, frames, engine):
    differences = list(check_exported(window_file(frames), Model(cropping_model(*frames)), DRIVE, engine))
    agree(differences, 7)
    assert max(row.bev for row in differences) < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("frames", [(0,), WINDOW])
def test_a_file_documents_its_window_and_all_inputs_and_outputs(window_file, frames):
    proto = onnx.load(window_file(frames))
    assert {node.domain for node in proto.graph.node} <= {"", "ai.onnx"}
    documented = {entry.key: entry.value for entry in proto.metadata_props}
    for values, key in ((proto.graph.input, "inputs"), (proto.graph.output, "outputs")):
        assert json.loads(documented[key]) == {value.name: value.doc_string for value in values}
        assert all(value.doc_string.startswith("(") for value in values)
    assert json.loads(documented["window"]) == list(frames)
    assert json.loads(documented["crop"]) == list(CROPPED.crop_box)
    names = {value.name for value in (*proto.graph.input, *proto.graph.output)}
    assert names.isdisjoint({"can_bus", "shift", "rotation", "previous_bev", "use_previous"})
    assert ({"previous_features", "image_features"} <= names) == (len(frames) > 1)


@pytest.mark.slow
def test_an_interrupted_run_of_a_file_is_resumed_with_its_window(window_file, tmp_path):
    model = load_model(window_file())
    run_into_folder(model, DRIVE, tmp_path / "whole")
    run_frames(6, model, DRIVE, tmp_path / "cut")
    run_into_folder(model, DRIVE, tmp_path / "cut", resume=True)
    for name in ("predictions.json", "tracks.csv"):
        assert (tmp_path / "cut" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


@pytest.mark.slow
def test_int8_is_close_to_float32(window_file, tmp_path):
    file, config = window_file(), load_model(window_file()).config
    quantize(file, calibration_images(config, 6, [DRIVE], 4), tmp_path / "int8.onnx")
    differences = list(check_exported(tmp_path / "int8.onnx", file, DRIVE, "onnxruntime"))
    assert 1e-5 < max(row.logits for row in differences) < 0.1
    assert load_model(tmp_path / "int8.onnx").precision == "int8"


def test_models_that_have_no_exported_form_are_refused(cropping_model, tmp_path):
    with torch.device("meta"):
        uniad = build_model(load_config("uniad-track-map"))
    for model, message in (
        (uniad, "uniad-track-map: a UniAD cannot be exported"),
        (cropping_model(-1, 0, 1), r"mini: a model that looks at later frames .* frames is \[-1, 0, 1\]"),
    ):
        with pytest.raises(BevcliError, match=message):
            export_onnx(model, tmp_path / "none.onnx")
    assert not (tmp_path / "none.onnx").exists()


@pytest.mark.slow
def test_commands_export_check_and_time_a_window(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = resources.files("bevcli").joinpath("configs/v2-t2.toml").read_text()
    for old, new in {
        'name = "v2-t2"': 'name = "small-v2"',
        "size = [1600, 900]": "size = [160, 90]",
        "crop = [0, 260, 1600, 900]": "crop = [0, 26, 160, 90]",
        "rows = 200": "rows = 12",
        "columns = 200": "columns = 10",
        "channels = 256": "channels = 32",
        "blocks = [3, 4, 6, 3]": "width = 8\nblocks = [1, 1, 1, 1]",
        "layers = 6": "layers = 1",
        "queries = 900": "queries = 30",
        "width = 512": "width = 48",
    }.items():
        assert old in text
        text = text.replace(old, new)
    Path("small.toml").write_text(text)
    checked = invoked("export-onnx", "--model", "small.toml", "--untrained", "--decode", "--check", STREET).stdout
    largest = checked.splitlines()[-1].split()
    assert largest[0] == "largest"
    assert float(largest[2]) < 1e-3
    timed = json.loads(invoked("bench", "--model", "small-v2.onnx", "--count", "1", "--json").stdout)
    assert (timed["model"], timed["engine"]) == ("small-v2", "onnxruntime")
    scores = json.loads(invoked("validate", "--model", "small-v2.onnx", "--data", STREET, "--json").stdout)
    assert "classes_with_ground_truth" in scores


@pytest.mark.slow
@pytest.mark.timeout(1800)  # each of its steps takes seconds in both programs
def test_the_published_window_equals_ours_over_a_real_drive(shared, tmp_path):
    drive = open_sequence(shared / "data" / "nuscenes-scene-0103", rate_hz=2.0, frames=slice(0, 4))
    model = Model(original.rule_model_v2("v2-t2"))
    export_onnx(model.network, tmp_path / "model.onnx")
    agree(list(check_exported(tmp_path / "model.onnx", model, drive)), 4, logits=2e-3)  # found: 1.002e-3, boxes 4 mm
