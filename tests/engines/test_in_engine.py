"""A model by its name in another engine: exported once, kept, made anew where the file is broken."""

import json
import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from threading import Barrier
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from command_line import invoked
from memory_drive import MemoryDrive, make_rig
from small_model import model_for_engines

from bevcli.errors import BevcliError, InputError
from bevcli.inference import run
from bevcli.inference.load import Model, installed_engines, load_model
from bevcli.sequences.open import select_range
from bevcli.workshop.engines import engine as module
from bevcli.workshop.engines.engine import CachedFile, OnnxRuntimeEngine, OpenVinoEngine, RoundingOpenVinoEngine
from bevcli.workshop.engines.exported import load_exported
from bevcli.workshop.live import Session

pytest.importorskip("onnxruntime")
pytest.importorskip("openvino")
STREET = Path(__file__).parents[2] / "samples" / "street"
REPLACED = ("export_onnx", "quantize", "CALIBRATION_FRAMES")  # by `steps`, for all tests after it
ORIGINAL = {name: getattr(module, name) for name in REPLACED}


@pytest.fixture(scope="module")
def network():
    return model_for_engines()


@pytest.fixture(scope="module")
def drive():
    return MemoryDrive(2, make_rig({"FRONT": 0.0, "BACK": 180.0}))


@pytest.fixture(scope="module")
def steps(tmp_path_factory, network, drive, small_file, int8_file):
    """The notes of the first use in INT8, in a cache of these tests. The export itself is that of the other tests."""

    def calibrated(file, images, out):
        assert list(images)
        shutil.copy(int8_file, out)

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        patch.setattr(module, "export_onnx", lambda network, path, options, **_: shutil.copy(small_file, path))
        patch.setattr(module, "quantize", calibrated)
        patch.setattr(module, "CALIBRATION_FRAMES", 2)
        seen = []
        patch.setattr(module, "_note", seen.append)
        chosen(network, "openvino", "int8").in_engine(drive.rig, drive)
        yield seen


def chosen(network, engine, precision="fp32", **settings) -> Model:
    return Model(network, engine=engine, precision=precision, **settings)


def boxes(model, drive):
    return [prediction.boxes for _, prediction in run(model, drive, track=False)]


@pytest.mark.slow
def test_the_boxes_in_an_engine_are_those_of_torch(steps, drive, network):
    expected = boxes(Model(network), drive)
    for engine in installed_engines():
        for mine, theirs in zip(boxes(chosen(network, engine), drive), expected, strict=True):
            np.testing.assert_allclose(mine.scores, theirs.scores, atol=1e-3)


def test_openvino_rounds_where_bfloat16_is_asked_for(steps, drive, network):
    try:
        RoundingOpenVinoEngine.require_packages()
    except BevcliError as error:
        pytest.skip(str(error))
    rounded = chosen(network, "openvino", "bf16").in_engine(drive.rig, drive)
    found = boxes(rounded, drive)  # one after the other: only the last file is kept open
    exact = chosen(network, "openvino").in_engine(drive.rig, drive)
    assert rounded.file == exact.file
    for mine, theirs in zip(found, boxes(exact, drive), strict=True):
        np.testing.assert_allclose(np.sort(mine.scores), np.sort(theirs.scores), atol=0.03)
        assert not np.array_equal(mine.scores, theirs.scores)
    assert rounded.engine_note.startswith("engine openvino, bf16; the exported file is /")


def test_a_processor_without_bfloat16_is_named(monkeypatch):
    monkeypatch.setattr(module, "_openvino_core", lambda: SimpleNamespace(get_property=lambda *_: ["FP32", "INT8"]))
    with pytest.raises(BevcliError, match="OpenVINO has no bfloat16 on this processor"):
        load_model("demo", engine="openvino", precision="bf16")


def test_the_first_time_says_what_it_does(steps, drive, network, caplog):
    once = ", once for these weights, number of cameras and image size"
    expected = ["exporting small-for-tests for 2 cameras to openvino", "calibrating small-for-tests with memory"]
    assert steps == [f"{text}{once}" for text in expected]
    found = chosen(network, "openvino", "int8").in_engine(drive.rig, drive)
    assert caplog.messages == []
    assert (found.engine, found.precision, found.is_exported) == ("openvino", "int8", True)
    assert found.engine_note.startswith("engine openvino, int8, calibrated with memory; the exported file is /")


def test_a_session_takes_the_file_and_int8_needs_frames(steps, drive, network):
    assert Session(chosen(network, "openvino", "int8"), drive.rig).notes == ()
    other = replace(drive.rig, cameras=drive.rig.cameras[:1])
    with pytest.raises(
        InputError, match=r"no frames to calibrate with: pass `calibrate_with` \(`--int8-drive DRIVE`\)"
    ):
        Session(chosen(network, "onnxruntime", "int8"), other)


@pytest.mark.slow
def test_a_broken_file_is_made_anew(steps, drive, network):
    model = chosen(network, "onnxruntime")
    file = model.in_engine(drive.rig, drive).file
    whole, facts = file.read_bytes(), file.with_suffix(".json")
    for path, broken in ((file, whole[:-100]), (facts, b'{"sha256": "0"}')):
        path.write_bytes(broken)
        assert model.in_engine(drive.rig, drive).file == file
        assert load_exported(file, "onnxruntime").cameras == 2
    assert not list(file.parent.glob(".unfinished*"))


@pytest.mark.slow
def test_a_longer_drive_is_not_run_with_a_file_of_a_short_one(steps, drive, network):
    short = select_range(drive, slice(0, 1))
    model = replace(chosen(network, "onnxruntime", "int8"), bundled=True)
    files = [model.in_engine(drive.rig, one).file for one in (short, short, drive, short)]
    assert files[0] == files[1] != files[2] == files[3]


@pytest.mark.slow
def test_two_processes_may_make_a_file_at_the_same_time(steps, small_file):
    both = Barrier(2, timeout=60)

    def make(file):
        with file.written() as path:
            shutil.copy(small_file, path)
            both.wait()
        return file.opened(OnnxRuntimeEngine, "drive")[1]

    file = CachedFile("same")
    with ThreadPoolExecutor(2) as pool:
        assert set(pool.map(make, [file, file])) == {"drive"}
    assert file.load(OnnxRuntimeEngine) is not None
    assert not list(file.path.parent.glob(".unfinished*"))


def test_probes_need_torch(drive, network):
    with pytest.raises(BevcliError, match=r"^attention and probes: not available in openvino.*leave out `engine=openv"):
        run(chosen(network, "openvino"), drive, attention=True)
    with pytest.raises(BevcliError, match=r"not available in openvino, but in PyTorch: leave out `precision=int8`"):
        run(chosen(network, "openvino", "int8"), drive, attention=True)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"engine": "openvinno"}, "unknown engine .expected torch, onnxruntime, openvino"),
        (
            {"engine": "openvino", "precision": "fp16"},
            r"`engine=openvino` \(`--engine openvino`\) computes in fp32 or bf16 or int8",
        ),
        ({"engine": "openvino", "device": "mps"}, "PyTorch sees no Apple GPU|runs on the CPU"),
        ({"engine": "torch", "precision": "int8"}, "PyTorch has no INT8"),
        ({"calibrate_with": STREET}, r"`calibrate_with` \(`--int8-drive`\): is for `precision=int8`"),
        ({"model": "uniad-track-map", "engine": "openvino"}, "a UniAD cannot be exported"),
    ],
)
def test_options_that_exclude_each_other_are_one_line(options, message):
    with pytest.raises(BevcliError, match=message):
        load_model(**{"model": "demo", "untrained": True, "device": "cpu", **options})


def test_int8_takes_the_first_engine_that_is_installed(monkeypatch):
    assert load_model("demo", precision="int8").engine == "openvino"
    monkeypatch.setattr(OpenVinoEngine, "packages", ("no_such_package",))
    assert load_model("demo", precision="int8").engine == "onnxruntime"
    monkeypatch.setattr(OnnxRuntimeEngine, "packages", ("no_such_package",))
    with pytest.raises(BevcliError, match=r"`precision=int8` \(.*\): no engine is installed"):
        load_model("demo", precision="int8")


def test_a_model_in_an_engine_needs_a_drive(network):
    with pytest.raises(BevcliError, match=r"`engine=openvino` \(`--engine`\): needs a drive"):
        chosen(network, "openvino").prepared.step(torch.zeros(1))


@pytest.mark.slow
def test_demo_runs_by_its_name_in_int8(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for name, original in ORIGINAL.items():
        monkeypatch.setattr(module, name, original)
    options = ["--engine", "openvino", "--precision", "int8"]
    done = invoked("run", STREET, *options, "--out", tmp_path / "run")
    assert "note: engine openvino, int8, calibrated with street" in done.stderr
    summary = json.loads((tmp_path / "run/summary.json").read_text())
    assert (summary["engine"], summary["precision"], summary["model"]) == ("openvino", "int8", "demo")
    files = {path: path.stat().st_ino for path in tmp_path.glob("cache/bevcli/engines/*.onnx")}
    done = invoked("validate", "--data", STREET, *options, "--json")
    reference = invoked("validate", "--data", STREET, "--json")
    maps = [json.loads(one.stdout)["classes_with_ground_truth"]["mean_ap"] for one in (done, reference)]
    assert abs(maps[0] - maps[1]) < 0.05
    assert files == {path: path.stat().st_ino for path in tmp_path.glob("cache/bevcli/engines/*.onnx")}
