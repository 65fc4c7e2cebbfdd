"""The program for a GPU that is there for minutes (photographs.py): its parts run on a CPU too."""

from __future__ import annotations

import time

import photographs

from bevcli.config import TRAINING, load_table
from bevcli.workshop.training.job import TrainingConfig


def test_the_model_file_names_the_material(tmp_path) -> None:
    plain = photographs.model_file(tmp_path / "plain.toml")
    with_material = photographs.model_file(tmp_path / "photographs.toml", tmp_path / "material")
    assert load_table(plain, TRAINING, TrainingConfig).rigs.material == ""
    assert load_table(with_material, TRAINING, TrainingConfig).rigs.material == str(tmp_path / "material")


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
