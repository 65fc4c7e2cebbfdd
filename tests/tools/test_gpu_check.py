"""`make gpu-check`: it needs a GPU, compares with the CPU, and reports what failed."""

import json
import math

import gpu_check
import pytest
import torch
from simulated_device import simulated

CPU = torch.device("cpu")


@pytest.mark.skipif(torch.cuda.is_available() or torch.backends.mps.is_available(), reason="there is a GPU")
@pytest.mark.parametrize("device", ["auto", "cuda:1", "mps"])
def test_without_a_gpu_it_says_so_in_one_line(device, capsys, tmp_path):
    assert gpu_check.main(["--device", device, "--out", str(tmp_path / "report.md")]) == 1
    printed = capsys.readouterr()
    assert printed.err.count("\n") == 1
    assert "no GPU" in printed.err or "no CUDA GPU" in printed.err or "no Apple GPU" in printed.err
    assert not (tmp_path / "report.md").exists()


@pytest.mark.slow
def test_a_device_that_agrees_with_the_cpu_passes(small_model_file, monkeypatch):
    monkeypatch.setattr(gpu_check, "PRECISIONS", ("fp32", "bf16"))
    monkeypatch.setattr(gpu_check, "COMPARED_ON_CPU", (str(small_model_file),))
    monkeypatch.setattr(gpu_check, "TIMED_STEPS", 3)
    monkeypatch.setattr(gpu_check, "measure_whole_run", lambda *inputs: {"run / model": 1.0})
    on_cpu, fp32, bf16 = gpu_check.measure_model(str(small_model_file), CPU)
    assert on_cpu["largest difference, m"] == 0
    assert fp32["boxes within 0.1 m"] == 1
    assert fp32["largest score difference"] < 1e-4
    assert "error" not in fp32
    assert fp32["wall, ms"] > 0
    assert bf16["largest difference, m"] > fp32["largest difference, m"]


@pytest.mark.slow
def test_a_model_is_measured_as_on_a_gpu(small_model_file, monkeypatch):
    """On a simulated GPU, so that no line fails first where a GPU is at hand for minutes only."""
    monkeypatch.setattr(gpu_check, "COMPARED_ON_CPU", (str(small_model_file),))
    monkeypatch.setattr(gpu_check, "RUNS_S", 1.0)
    with simulated("cuda:0", monkeypatch, lambda *_, **__: None) as device:
        on_cpu, *rows = gpu_check.measure_model(str(small_model_file), device.device)
    assert on_cpu["boxes within 0.1 m"] == 1
    assert [row["precision"] for row in rows] == ["fp16", "bf16", "fp32"]
    assert not [row["error"] for row in rows if "error" in row]
    assert rows[0].keys() == gpu_check.COLUMNS.keys() - {"error"}
    assert all(row["wall, ms"] > 0 for row in rows)


def test_numbers_that_are_too_far_apart_are_an_error():
    def moved(metres: list[float], score: float = 0.0) -> dict[str, object]:
        plain = torch.zeros(len(metres), 3), torch.zeros(len(metres), 1)
        found = torch.tensor(metres)[:, None] * torch.tensor([1.0, 0, 0]), torch.full((len(metres), 1), score)
        return gpu_check.differences([found], [plain])

    assert "error" not in moved([0.01] * 99 + [5.0])
    assert moved([0.01] * 98 + [5.0] * 2)["error"] == "differs too much"
    assert moved([0.01] * 99, 0.5)["error"] == "differs too much"
    assert moved([math.nan] * 99, math.nan)["error"] == "differs too much"


def printing(*rows: dict[str, object]) -> list[str]:
    """A command that prints rows as a part of the check does."""
    return ["sh", "-c", "".join(f"echo '{json.dumps(row)}'; " for row in rows)]


def test_a_part_that_fails_does_not_end_the_others(monkeypatch, tmp_path, capsys):
    fails = ["sh", "-c", "echo CUDA error: an illegal memory access was encountered >&2; exit 3"]
    rows = (
        {"model": "demo", "precision": "fp16", "wall, ms": 2.345},
        {"model": "demo", "precision": "bf16", "error": "a|b"},
    )
    commands = {"tiny": fails, "demo": printing(*rows)}
    monkeypatch.setattr(gpu_check, "own_part", lambda kind, model, *rest, device: commands[model])
    monkeypatch.setattr(gpu_check.Check, "train", lambda check: "Losses fall.")
    monkeypatch.setattr(gpu_check.Check, "run_tests", lambda check: "`1 passed`")
    out = tmp_path / "report.md"
    assert gpu_check.main(["--device", "cpu", "--model", "tiny", "--model", "demo", "--out", str(out)]) == 1
    text = out.read_text()
    assert "tiny: exit code 3 ``` CUDA error: an illegal memory access was encountered ``` |\n" in text
    assert "| demo | fp16 | 2.35 |" in text or "| demo | fp16 | 2.34 |" in text
    assert "| a/b |\n" in text
    assert text.count(": passed\n") == 2
    printed = capsys.readouterr().out
    assert "failed: " in printed
    assert all(line in printed for line in text.splitlines())


def test_a_process_that_hangs_ends_with_the_time(monkeypatch, tmp_path):
    monkeypatch.setattr(gpu_check, "BUDGET_S", 0.1)
    check = gpu_check.Check(CPU, tmp_path / "report.md")
    with pytest.raises(gpu_check.CheckFailed, match=r"b: not done when its part of the 0\.1 s of the check was over"):
        list(check.process(["sleep", "5"], "b"))
    with pytest.raises(gpu_check.CheckFailed, match=r"c: not run, because its part of the 0\.1 s of the check is over"):
        list(check.process(["sleep", "5"], "c"))


@pytest.mark.slow
def test_the_whole_check_on_the_cpu(small_model_file, tmp_path, monkeypatch):
    """As on a GPU, with a small model; `train` too."""
    monkeypatch.setattr(gpu_check.Check, "run_tests", lambda check: "`1 passed`")
    monkeypatch.setattr(gpu_check, "TRAINED_MODEL", str(small_model_file))
    monkeypatch.setattr(gpu_check, "TRAINED_S", 1.0)
    out = tmp_path / "report.md"
    gpu_check.main(["--device", "cpu", "--model", str(small_model_file), "--out", str(out)])
    text = out.read_text()
    assert "exit code" not in text
    assert "## training: passed" in text
    assert "fp32 |" in text
