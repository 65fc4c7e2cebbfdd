"""`bevcli reproduce`: our scores next to published ones, on four real frames with random weights."""

import json
import sys
from pathlib import Path

import pytest
import safetensors.torch
import torch
import typer
from command_line import MINI_TOML, command

from bevcli.config import load_config
from bevcli.geometry.object_classes import NUSCENES_CLASSES
from bevcli.model.temporal_model import build_model
from bevcli.published import own_table
from bevcli.workshop.batch import ray_is_installed
from bevcli.workshop.batch.commands import compare_with_published, table_of

ERRORS = {"trans_err": 0.7, "scale_err": 0.3, "orient_err": 0.4, "vel_err": 0.5, "attr_err": None}
METRICS = {
    "nd_score": 0.512,
    "mean_ap": 0.4,
    "frames": 6019,
    "tp_errors": ERRORS,
    "mean_dist_aps": dict.fromkeys(NUSCENES_CLASSES, 0.4),
    "label_tp_errors": dict.fromkeys(NUSCENES_CLASSES, ERRORS),
    "classes_with_ground_truth": {"classes": list(NUSCENES_CLASSES)},
}


def test_a_table_has_ours_the_published_and_the_difference():
    found = compare_with_published(METRICS, {"NDS": 0.517, "mAP": 0.4, "mATE": 0.673})
    lines = [line.split() for line in table_of(found["scores"]).splitlines()]
    assert lines[:4] == [
        ["score", "ours", "published", "difference"],
        ["NDS", "%", "51.2", "51.7", "-0.5"],
        ["mAP", "%", "40.0", "40.0", "+0.0"],
        ["mATE", "m", "0.700", "0.673", "+0.027"],
    ]
    assert lines[-1] == ["mAAE", "–", "–", "–"]
    assert found["notes"] == []


def test_notes_tell_what_need_not_agree():
    found = compare_with_published({**METRICS, "frames": 81}, {"AMOTA": 0.39})
    assert "6,019 frames of the validation split, these of 81" in found["notes"][0]
    assert found["notes"][1].startswith("AMOTA: not measured here")
    assert found["scores"]["AMOTA"] == {"name": "AMOTA", "ours": None, "published": 0.39, "difference": None}


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder in which the name "own" has weights, and "far" a source that cannot be reached."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "settings"))
    monkeypatch.setenv("BEVCLI_WEIGHTS_DIR", str(tmp_path / "weights"))
    (tmp_path / "mini.toml").write_text(MINI_TOML)
    torch.manual_seed(0)
    state = build_model(load_config(tmp_path / "mini.toml")).state_dict()
    safetensors.torch.save_file({key: each.contiguous() for key, each in state.items()}, tmp_path / "own.safetensors")
    model = f"model = '{tmp_path / 'mini.toml'}'"
    own_table().parent.mkdir(parents=True)
    own_table().write_text(
        f"[own]\n{model}\nsource = '{tmp_path / 'own.safetensors'}'\npublished = {{ NDS = 0.5, mAP = 0.4 }}\n"
        f"[far]\n{model}\nsource = 'https://127.0.0.1:1/far.pth'\nbytes = 5000000\n"
    )
    return tmp_path


def test_real_frames_are_scored_and_an_interrupted_run_goes_on(place, shared):
    root = shared / "data/nuscenes-mini-4"
    arguments = ("reproduce", "own", "--data", root, "--split", "mini_val", "--workers", 1, "--out", "out")
    done = command(place, *arguments)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[1].split()[:2] == ["NDS", "%"]
    assert "these of 4: they need not agree" in done.stderr
    [result] = (place / "out/drives").iterdir()
    written = result.stat().st_mtime_ns
    assert "pass `resume=True` (`--resume`) to go on with it" in command(place, *arguments).stderr
    again = command(place, *arguments, "--resume", "--json")
    assert json.loads(again.stdout)["scores"]["NDS"]["published"] == 0.5
    assert result.stat().st_mtime_ns == written


@pytest.mark.slow
@pytest.mark.skipif(not ray_is_installed(), reason="Ray is not installed")
def test_ray_gives_the_same_scores(place, shared):
    root = shared / "data/nuscenes-mini-4"
    arguments = ("reproduce", "own", "--data", root, "--threads", 1, "--json")
    here = command(place, *arguments, "--workers", 1, "--out", "here")
    on_ray = command(place, *arguments, "--workers", 2, "--out", "on_ray")
    assert on_ray.returncode == 0, on_ray.stderr
    assert json.loads(on_ray.stdout) == json.loads(here.stdout)


def test_a_download_is_asked_for_first(place, shared, monkeypatch):
    """Without a terminal there is nobody to ask."""
    arguments = ("reproduce", "far", "--data", shared / "data/nuscenes-mini-4", "--out", "out")
    done = command(place, *arguments)
    assert "the weights far are not here: https://127.0.0.1:1/far.pth (5.0 MB): pass --fetch to" in done.stderr
    asked = []
    monkeypatch.setattr(sys, "stdin", type("Terminal", (), {"isatty": lambda self: True})())
    monkeypatch.setattr(typer, "confirm", lambda question, **settings: asked.append(question))
    assert "without its weights nothing can be scored" in command(place, *arguments).stderr
    assert asked == ["the weights far are not here: https://127.0.0.1:1/far.pth (5.0 MB). Download them?"]
    assert not (place / "weights").exists()
    assert not (place / "out").exists()


def test_mistakes_are_one_line(place):
    done = command(place, "reproduce", "own", "--data", place, "--workers", 1)
    assert done.stderr == f"error: {place}: is not a nuScenes root (expected a folder with v1.0-*/scene.json)\n"
    assert done.returncode == 1
