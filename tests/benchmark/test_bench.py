"""`bevcli bench`: its output, its times, and the number of operations."""

import json
import runpy
import subprocess
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch
from command_line import invoked

from bevcli.config import load_config
from bevcli.errors import BevcliError
from bevcli.inference.load import installed_engines
from bevcli.inference.preprocess import Preprocessor
from bevcli.model.pillar_projection import find_hits, project_pillars
from bevcli.workshop.benchmark import measure, versions
from bevcli.workshop.benchmark.measure import BenchmarkResult, MachineLimits, count_operations
from bevcli.workshop.benchmark.versions import Comparison, MadeUpDrive, made_up_model


@pytest.fixture(scope="module", autouse=True)
def small_images():
    """Images of a fourth of the width and the same field of view."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("WIDTH", "HEIGHT", "FOCAL_LENGTH", "BACK_FOCAL_LENGTH"):
            patch.setattr(versions, name, getattr(versions, name) // 4)
        patch.setattr(versions, "_jpeg", cache(versions._jpeg))
        yield


RESULT = BenchmarkResult(
    model="tiny",
    device="cpu",
    precision="fp32",
    machine="two cores",
    stages_s={"backbone": (1.0, 3.0, 2.0)},
    frame_s=(2.0, 4.0, 3.0),
    run_frame_s=3.3,
    run_over_model=1.1,
    peak_memory_bytes=2_000_000,
    operations=400e9,
    limits=MachineLimits(gemm_gflops=200.0, copy_gbs=10.0),
    comparison=Comparison((9.0, 6.0, 5.0), 0.02, 1.0, 1e-5),
)


def test_the_text_contains_the_derived_numbers():
    text = RESULT.text()
    for words in (
        "1.50 times their time",
        "0.333 frames per second",
        "1.10 times the model alone",
        "2.00 times the prepared model's",
        "100.0%",
    ):
        assert words in text


def test_a_table_has_all_rows_but_those_that_fail(tmp_path):
    script = runpy.run_path(str(Path(__file__).parents[2] / "docs/site/speed_table.py"))
    script = script["write_table"].__globals__
    document = tmp_path / "speed.md"
    document.write_text(f"before\n{script['BEGIN']}\nold\n{script['END']}\nafter\n")
    rows = []

    def measured(model: str, precision: str, *_: object) -> dict[str, object]:
        rows.append(document.read_text().count("| two"))
        if model == "two" and precision == "bf16":
            raise subprocess.TimeoutExpired("bench", 4 * 3600)
        return replace(RESULT, model=model, precision=precision).as_data()

    script["measure"], script["known_models"] = measured, lambda: ["one", "two", "three"]
    script["has_onednn"] = lambda _: True
    with pytest.raises(SystemExit, match="1 of 6 measurements failed"):
        script["write_table"](document, "cpu")
    text = document.read_text()
    assert [line.split(" | ")[0] for line in text.splitlines() if "| bf16 " in line] == ["| one", "| three"]
    assert (text.startswith("before\n"), text.endswith("after\n"), "old" in text) == (True, True, False)
    assert rows == [0, 0, 0, 1, 1, 1]  # written after each measurement


def test_json_of_a_whole_benchmark(small_model_file, monkeypatch):
    monkeypatch.setattr(measure, "RUNS", 1)
    monkeypatch.setattr(measure, "RUN_FRAMES", 4)
    monkeypatch.setattr(measure, "CPU_EDGE", 256)
    monkeypatch.setattr(measure, "COPIED_FLOATS", 1 << 20)
    answer = invoked("bench", "--model", small_model_file, "--count", 1, "--against", "plain", "--json")
    data = json.loads(answer.stdout)
    assert set(data) >= {
        "model", "device", "precision", "stages_ms", "frame_ms", "run_over_model", "fps", "peak_memory_mb",
        "operations_g", "limits", "plain_frame_ms", "speedup", "max_box_difference_m", "share_within_0.1_m",
        "max_score_difference",
    }  # fmt: skip
    assert set(data["limits"]) == {"gemm_gflops", "copy_gbs", "times_limit"}
    assert list(data["stages_ms"]) == [
        "decode", "preprocess", "input", "backbone", "neck", "projection", "temporal attention", "spatial attention",
        "FFN", "decoder and head", "box_decoding", "recording",
    ]  # fmt: skip
    assert all(milliseconds > 0 for milliseconds in data["stages_ms"].values())
    assert 0 < data["max_box_difference_m"] < 1e-2
    assert 0 < data["max_score_difference"] < 1e-4
    assert data["share_within_0.1_m"] == 1


def test_the_limit_of_a_cpu_without_bfloat16_is_that_of_float32(monkeypatch):
    dtypes, multiply = [], torch.mm
    monkeypatch.setattr(measure, "CPU_EDGE", 8)
    monkeypatch.setattr(measure, "COPIED_FLOATS", 8)
    monkeypatch.setattr(measure, "has_onednn", lambda dtype: dtype == torch.float32)
    monkeypatch.setattr(torch, "mm", lambda one, *more, **out: dtypes.append(one.dtype) or multiply(one, *more, **out))
    measure.measure_limits(torch.device("cpu"), "bf16")
    assert set(dtypes) == {torch.float32}


@pytest.mark.slow
def test_profile_of_a_frame_in_half_precision(small_model_file, tmp_path):
    profile = tmp_path / "profile.json"
    options = ["--precision", "bf16", "--count", 1, "--profile", profile]
    answer = invoked("bench", "--model", small_model_file, *options)
    assert "bf16" in answer.stdout
    assert json.loads(profile.read_text())["traceEvents"]
    with pytest.raises(BevcliError, match=r"none/p\.json: cannot be written"):
        invoked("bench", "--model", small_model_file, "--count", 1, "--profile", tmp_path / "none/p.json")


def test_engines_are_compared_as_they_are():
    with pytest.raises(BevcliError, match="--engines compares all of them"):
        invoked("bench", "--engines", "--precision", "int8")


@pytest.mark.slow
def test_engines_are_timed_side_by_side(small_model_file, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    done = invoked("bench", "--engines", "--model", small_model_file, "--count", 2, "--json")
    rows = {(row["engine"], row["precision"]): row for row in json.loads(done.stdout)["engines"]}
    assert {engine for engine, _ in rows} == {"torch", *installed_engines()}
    assert rows["torch", "fp32"]["largest_m"] == 0
    assert rows["openvino", "fp32"]["largest_m"] < 1e-3
    assert {precision for engine, precision in rows if engine == "openvino"} == {"fp32", "bf16", "int8"}
    measured = [row for row in rows.values() if "OpenVINO has no bfloat16" not in row["problem"]]
    assert all(len(row["seconds"]) == 2 for row in measured)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA GPU")
def test_on_a_gpu_the_stages_add_up_to_the_frame(small_model_file):
    answer = invoked("bench", "--model", small_model_file, "--device", "cuda", "--against", "plain", "--json")
    data = json.loads(answer.stdout)
    inside = set(data["stages_ms"]) - {"decode", "preprocess", "recording"}
    assert sum(data["stages_ms"][stage] for stage in inside) <= 1.2 * max(data["frame_ms_spread"])
    assert data["share_within_0.1_m"] > 0.5


@pytest.mark.slow
def test_tiny_needs_slightly_more_operations_than_six_resnet50():
    resnet50 = 2 * 4.09e9  # for one image of 224 x 224, as published with the weights
    backbone = 6 * resnet50 * (480 * 800) / 224**2
    assert 1.02 * backbone < count_operations(load_config("tiny"), (400,) * 6) < 1.12 * backbone


@pytest.mark.slow
def test_the_cameras_see_about_as_many_cells_as_nuscenes():
    config = load_config("tiny")
    prepared = Preprocessor(config)(MadeUpDrive(1).load(0))
    pillars = torch.as_tensor(config.bev_grid.pillars()).float().flatten(0, 1)
    hits = find_hits(project_pillars(prepared.image_from_bev, pillars, (480, 800), prepared.has_image))
    # 2812 in a real nuScenes frame, the first of the reference numbers.
    assert 0.95 * 2812 < sum(hits.hits_per_camera) < 1.05 * 2812


def test_no_matrix_is_zero_and_every_call_gives_the_same_weights(mini_config):
    model, again = made_up_model(mini_config), made_up_model(mini_config)
    assert all(parameter.any() for parameter in model.parameters() if parameter.ndim > 1)
    state = again.state_dict()
    assert all(torch.equal(tensor, state[name]) for name, tensor in model.state_dict().items())
