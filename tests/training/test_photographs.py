"""The program for a GPU that is there for minutes (photographs.py): its parts run on a CPU too."""

from __future__ import annotations

import time

import photographs
import pytest
import torch

from bevcli.config import load_config
from bevcli.model.network import build_network
from bevcli.workshop.training.augmentation import RandomisationConfig


@pytest.mark.slow
def test_teaching_changes_the_neck_and_the_upper_stages_only(tmp_path) -> None:
    torch.manual_seed(0)
    model = build_network(load_config(photographs.model_file(tmp_path / "photographs.toml")))
    before = {name: value.clone() for name, value in model.named_parameters()}
    width, height = load_config("demo").image.padded_size
    images = [torch.randint(256, (2, 3, height, width), dtype=torch.uint8) for _ in range(2)]
    chance = RandomisationConfig(0.5, 0.5, 0.5, 0.5, 0.5, 0.5)
    photographs.teach(model, images, chance, seconds=1e-3, new_neck=True)
    changed = {name for name, value in model.named_parameters() if not torch.equal(value, before[name])}
    lower = [f"backbone.stages.{stage}." for stage in range(photographs.FIRST_TAUGHT_STAGE - 1)]
    assert changed
    assert all(name.startswith(("neck.", "backbone.stages.")) for name in changed)
    assert not [name for name in changed if name.startswith(tuple(lower))]


def test_the_learning_rate_falls_with_the_time() -> None:
    now = time.perf_counter()
    rates = [
        photographs.TimedOptimizer(learning_rate=1.0, end_s=now + 10, begun_s=[now - done_s]).learning_rate_at(0, 1)
        for done_s in (5, 10, 20, 60)
    ]
    assert rates == sorted(rates, reverse=True)
    assert rates[0] > 0.5
    assert rates[-1] < 0.1


def test_too_few_drives_are_one_line(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(photographs, "rendered", lambda *_: (20000,))
    monkeypatch.setattr("sys.argv", ["photographs.py", str(tmp_path)])
    assert photographs.main() == 1
    assert "found 1 drives" in capsys.readouterr().out
