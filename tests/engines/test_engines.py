"""ONNX Runtime and OpenVINO in the place of PyTorch: the commands run an exported file, and INT8 stays close to it."""

import gc
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import invoked
from forks import FORKS
from memory_drive import MemoryDrive, make_camera
from small_model import check_file, model_for_engines, small_inputs, step_of_file

from bevcli.cli.stop_signals import EndSignals
from bevcli.config import load_config
from bevcli.errors import BevcliError, ConfigError, InputError, WeightsError
from bevcli.geometry.cameras import CameraRig, default_ego_from_bev
from bevcli.inference import run
from bevcli.inference.load import load_model
from bevcli.inference.preprocess import Preprocessor
from bevcli.inference.runner import Runner
from bevcli.inference.tracking import TrackerConfig
from bevcli.model.efficientnet_lite import EfficientNetLiteConfig
from bevcli.registry import entries
from bevcli.sequences.open import open_sequence
from bevcli.workshop.engines.export_form import pixels_of
from bevcli.workshop.engines.export_onnx import calibration_images, export_onnx, quantize
from bevcli.workshop.engines.exported import load_exported

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")
pytest.importorskip("openvino")
STREET = Path(__file__).parents[2] / "samples" / "street"


@pytest.mark.parametrize("engine", list(entries("bevcli.engines")))
def test_an_engine_equals_the_model_with_and_without_history(small_file, loaded, engine):
    check_file(loaded(small_file, engine), model_for_engines())


@pytest.mark.slow
def test_ctrl_c_reaches_python_after_openvino_models_are_gone(small_file):
    """On processors with AMX it ended the process with a segmentation fault."""
    models = [load_exported(small_file, "openvino") for _ in range(2)]
    while models:
        del models[0]
        gc.collect()
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)


def test_a_file_tells_its_model_and_that_its_weights_are_random(small_file):
    model = load_model(small_file)
    assert model.config == model_for_engines().config
    assert model.tracker == TrackerConfig(birth_score=0.5).for_classes(model.config.object_classes)
    assert model.untrained
    assert model.prepared is model.network


@pytest.mark.parametrize("in_a_run", [True, False])
def test_a_file_gets_the_pixels_of_images_that_fit(small_file, loaded, in_a_run, monkeypatch):
    """To the bit in a run, up to rounding where the frame was prepared for the model; a missing one is the mean."""
    exported = loaded(small_file, "onnxruntime")
    width, height = exported.config.image.size
    camera = make_camera("FRONT", 0, width, height)
    drive = MemoryDrive(1, CameraRig((camera, replace(camera, name="BACK")), default_ego_from_bev()))
    frame = drive.load(0)
    pixels = np.random.default_rng(1).integers(0, 256, (height, width, 3), dtype=np.uint8)
    frame = replace(frame, images={"FRONT": replace(frame.images["FRONT"], pixels_bgr=pixels)})
    runner, feeds = Runner(exported, torch.device("cpu"), pixels=True), []
    run_file = exported.outputs_by_name
    monkeypatch.setattr(exported, "outputs_by_name", lambda feed: feeds.append(feed) or run_file(feed))
    runner.step(None, (runner.preprocess if in_a_run else Preprocessor(exported.config))(frame))
    found, tolerance = feeds[0]["images"].numpy(), 0 if in_a_run else 1e-4
    np.testing.assert_allclose(found[0, 0], pixels, atol=tolerance, rtol=0)
    np.testing.assert_allclose(found[0, 1], np.full_like(pixels, 120), atol=tolerance, rtol=0)


@pytest.mark.parametrize("engine", ["onnxruntime", pytest.param("openvino", marks=pytest.mark.slow)])
def test_int8_is_close_and_only_image_features_are_rounded(small_file, int8_file, loaded, engine):
    assert load_model(int8_file).precision == "int8"
    exact, rounded = (loaded(file, engine) for file in (small_file, int8_file))
    with torch.inference_mode():
        expected, found = (step_of_file(file, small_inputs()).bev for file in (exact, rounded))
    difference = (found - expected).norm() / expected.norm()
    assert 1e-5 < difference < 0.1
    proto = onnx.load(int8_file)
    quantizers = [node for node in proto.graph.node if node.op_type == "QuantizeLinear"]
    readers = [node for node in proto.graph.node if node.op_type == "Conv"]
    assert len(quantizers) > 10
    assert all(name.endswith("DequantizeLinear_Output") for node in readers for name in node.input[:2])
    weights = [value.name for value in proto.graph.initializer if value.name.endswith("weight_quantized")]
    assert len(weights) == len(readers)  # of the convolutions, and no others


@pytest.mark.slow  # exports a model of its own
def test_efficientnet_lite_runs_in_an_engine_and_in_int8(tmp_path):
    model = model_for_engines(EfficientNetLiteConfig())
    exact, rounded = tmp_path / "lite.onnx", tmp_path / "lite-int8.onnx"
    export_onnx(model, exact, decode=True, untrained=True)
    images = [pixels_of(small_inputs(seed).images, model.config.image).movedim(2, -1).numpy() for seed in range(4)]
    quantize(exact, images, rounded)
    files = [load_exported(file, "onnxruntime") for file in (exact, rounded)]
    with torch.inference_mode():
        expected, found, close = model(small_inputs()).bev, *(step_of_file(file, small_inputs()).bev for file in files)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4)
    assert 1e-5 < (close - expected).norm() / expected.norm() < 0.15  # of random weights


def test_more_cameras_on_a_cell_than_slots_are_an_error(small_file, loaded, tmp_path):
    model = model_for_engines()
    inputs = small_inputs()
    inputs.image_from_bev[:, 1] = inputs.image_from_bev[:, 0]  # both cameras look the same way
    with torch.inference_mode():
        expected = model(inputs).bev
        found = step_of_file(loaded(small_file, "onnxruntime"), inputs).bev
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4)
    one = tmp_path / "one.onnx"
    proto = onnx.load(small_file)
    for entry in proto.metadata_props:
        entry.value = "1" if entry.key == "cameras_per_cell" else entry.value
    onnx.save(proto, one)
    with pytest.raises(
        WeightsError, match=r"takes 1 camera per BEV cell, .* has 2: use `bevcli export-onnx --cameras-per-cell 2`"
    ):
        step_of_file(load_exported(one, "onnxruntime"), inputs)


def test_a_model_in_the_metadata_is_checked_like_a_model_file(small_file, tmp_path):
    proto = onnx.load(small_file)
    for key, value, error, message in (
        ("config", '{"name": "x", "wings": 2}', ConfigError, 'unknown key "wings"'),
        ("config", "[1]", WeightsError, "expected a table"),
        ("config", None, WeightsError, "its metadata lacks config"),
    ):
        metadata = {entry.key: entry.value for entry in proto.metadata_props} | {key: value}
        onnx.helper.set_model_props(proto, {name: text for name, text in metadata.items() if text is not None})
        onnx.save(proto, tmp_path / "changed.onnx")
        with pytest.raises(error, match=message):
            load_model(tmp_path / "changed.onnx")


def test_a_node_that_fails_when_it_runs_is_one_line(small_file, tmp_path):
    """The indices of a Gather lie outside of its data, which ONNX Runtime finds only when it runs."""
    proto = onnx.load(small_file)
    name = "most_cameras_per_cell"
    for node in proto.graph.node:
        node.output[:] = ["before" if each == name else each for each in node.output]
    nodes = [
        onnx.helper.make_node("Add", ["before", "far"], ["outside"]),
        onnx.helper.make_node("Gather", ["few", "outside"], [name]),
    ]
    proto.graph.node.extend(nodes)
    for each, value in (("far", [1000]), ("few", [1, 2])):
        proto.graph.initializer.append(onnx.helper.make_tensor(each, onnx.TensorProto.INT64, [len(value)], value))
    onnx.save(proto, tmp_path / "fails.onnx")
    model = load_exported(tmp_path / "fails.onnx", "onnxruntime")
    with pytest.raises(WeightsError, match=r"fails\.onnx: fails when it runs") as caught:
        step_of_file(model, small_inputs())
    assert "\n" not in str(caught.value)


@pytest.fixture(scope="module")
def endless_file(small_file) -> Path:
    """Its step has a loop of 2^62 trips, which ONNX Runtime never leaves by itself."""
    make, kinds = onnx.helper, onnx.TensorProto
    states = [make.make_tensor_value_info(*each) for each in (("trip", kinds.INT64, []), ("go", kinds.BOOL, []))]
    value, total = (make.make_tensor_value_info(name, kinds.INT64, [1]) for name in ("value", "total"))
    go_on = make.make_tensor_value_info("go_on", kinds.BOOL, [])
    nodes = [make.make_node("Identity", ["go"], ["go_on"]), make.make_node("Add", ["value", "one"], ["total"])]
    body = make.make_graph(nodes, "body", [*states, value], [go_on, total])
    proto, name = onnx.load(small_file), "most_cameras_per_cell"
    for node in proto.graph.node:
        node.output[:] = ["before" if each == name else each for each in node.output]
    proto.graph.node.append(make.make_node("Loop", ["trips", "", "before"], [name], body=body))
    for each, shape, numbers in (("trips", [], [1 << 62]), ("one", [1], [1])):
        proto.graph.initializer.append(make.make_tensor(each, kinds.INT64, shape, numbers))
    file = small_file.with_name("endless.onnx")
    onnx.save(proto, file)
    return file


@pytest.mark.parametrize("number", [pytest.param(signal.SIGINT, marks=pytest.mark.slow), signal.SIGTERM])
def test_two_signals_end_an_endless_loop_of_a_file(endless_file, tmp_path, number):
    process = FORKS.Process(target=run_for_ever, args=(endless_file, tmp_path / "ready"))
    process.start()
    end = time.monotonic() + 60
    while not (tmp_path / "ready").exists():
        assert process.is_alive()
        assert time.monotonic() < end
        time.sleep(0.02)
    for _ in range(2):
        time.sleep(0.2)
        os.kill(process.pid, number)
    process.join(10)
    assert process.exitcode == 128 + number


def run_for_ever(file: Path, ready: Path) -> None:
    """Run a file with the signals of the program, which every command has."""
    EndSignals().start()
    model = load_exported(file, "onnxruntime")
    ready.touch()
    step_of_file(model, small_inputs())


def test_an_output_that_is_missing_or_misshapen_is_named(small_file, tmp_path):
    proto = onnx.load(small_file)
    kept = [value for value in proto.graph.output if value.name != "box_codes"]
    logits = next(value for value in proto.graph.output if value.name == "class_logits")
    for change, message in ((kept, "has no output box_codes"), (None, "output box_codes has shape")):
        del proto.graph.output[:]
        proto.graph.output.extend(kept)
        if change is None:
            proto.graph.node.append(onnx.helper.make_node("Identity", ["class_logits"], ["box_codes"]))
            wrong = onnx.ValueInfoProto()
            wrong.CopyFrom(logits)
            wrong.name = "box_codes"
            for node in proto.graph.node[:-1]:
                for names in (node.input, node.output):
                    names[:] = ["unused" if each == "box_codes" else each for each in names]
            proto.graph.output.append(wrong)
        onnx.save(proto, tmp_path / "changed.onnx")
        with pytest.raises(WeightsError, match=message):
            step_of_file(load_exported(tmp_path / "changed.onnx", "onnxruntime"), small_inputs())


def test_drives_without_images_calibrate_nothing(tmp_path):
    shutil.copytree(STREET, tmp_path / "street")
    for image in (tmp_path / "street" / "images").rglob("*.*"):
        image.unlink()
    drive = open_sequence(tmp_path / "street")
    with pytest.raises(InputError, match="none of the 2 frames for the calibration has an image"):
        list(calibration_images(load_config("demo"), len(drive.rig.cameras), [drive], 2))


def test_options_that_do_not_apply_are_named(small_file, int8_file):
    for options, message in (
        ({"weights": "w.pth"}, "an exported file holds its weights: leave out `weights=w.pth`"),
        ({"untrained": True}, "leave out `untrained"),
        ({"precision": "bf16"}, r"`precision=bf16` \(`--precision`\): .* has a fixed precision"),
        ({"device": "cuda"}, r"`device=cuda` \(`--device`\): .* runs on the CPU"),
    ):
        with pytest.raises(BevcliError, match=message):
            load_model(small_file, **options)
    with pytest.raises(WeightsError, match="is quantised already"):
        quantize(int8_file, [], int8_file.with_name("again.onnx"))
    with pytest.raises(BevcliError, match="attention and probes: not available"):
        run(load_model(small_file), open_sequence(STREET), attention=True)


@pytest.mark.slow
def test_every_command_runs_demo_from_a_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    invoked("export-onnx", "--model", "demo")
    invoked("quantize", "demo.onnx", "--int8-drive", STREET, "--count", "4", "--check", STREET)
    expected = [prediction.boxes for _, prediction in run(load_model("demo"), open_sequence(STREET))]
    for engine in entries("bevcli.engines"):
        invoked("run", STREET, "--model", "demo.onnx", "--engine", engine, "--out", engine)
        found = json.loads((tmp_path / engine / "predictions.json").read_text())
        first = found["frames"][0]["boxes"][0]
        np.testing.assert_allclose(first["score"], expected[0].scores[0], atol=1e-3)
        summary = json.loads((tmp_path / engine / "summary.json").read_text())
        assert (summary["model"], summary["engine"], summary["untrained"]) == ("demo", engine, False)
    scores = json.loads(invoked("validate", "--model", "demo-int8.onnx", "--data", STREET, "--json").stdout)
    reference = json.loads(invoked("validate", "--model", "demo", "--data", STREET, "--json").stdout)
    maps = [found["classes_with_ground_truth"]["mean_ap"] for found in (scores, reference)]
    assert abs(maps[0] - maps[1]) < 0.05  # a drive of few frames; docs/speed.md has more
    timed = json.loads(invoked("bench", "--model", "demo-int8.onnx", "--count", "2", "--json").stdout)
    assert (timed["precision"], timed["engine"]) == ("int8", "onnxruntime")


@pytest.mark.slow
def test_openvino_opens_no_connection(small_file):
    watched = f"""
import sys
def watch(event, arguments):
    if event in ("socket.connect", "socket.getaddrinfo", "socket.sendto", "socket.bind"):
        print("CONNECTION", event, arguments, file=sys.stderr)
sys.addaudithook(watch)
from pathlib import Path
from bevcli.workshop.engines.exported import load_exported
load_exported(Path({str(small_file)!r}), "openvino")
"""
    done = subprocess.run([sys.executable, "-c", watched], capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    assert "CONNECTION" not in done.stderr
