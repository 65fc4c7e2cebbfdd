"""`make gpu-check`: it needs a GPU, compares with the CPU, and reports what failed."""

from __future__ import annotations

import math

import gpu_check
import pytest
import torch

CPU = torch.device("cpu")


@pytest.mark.skipif(torch.cuda.is_available() or torch.backends.mps.is_available(), reason="there is a GPU")
@pytest.mark.parametrize("device", ["auto", "cuda:1", "mps"])
def test_without_a_gpu_it_says_so_in_one_line(device, capsys, tmp_path):
    assert gpu_check.main(["--device", device, "--out", str(tmp_path / "report.md")]) == 1
    printed = capsys.readouterr()
    assert printed.err.count("\n") == 1
    assert "no GPU" in printed.err or "no CUDA GPU" in printed.err or "no Apple GPU" in printed.err
    assert not (tmp_path / "report.md").exists()


def test_a_device_that_agrees_with_the_cpu_passes(small_model_file, monkeypatch):
    monkeypatch.setattr(gpu_check, "PRECISIONS", ("fp32", "bf16"))
    fp32, bf16 = gpu_check.compare(str(small_model_file), CPU)
    assert fp32["share"] == 1
    assert fp32["score"] < 1e-4
    assert "error" not in fp32
    assert bf16["distance_m"] > fp32["distance_m"]


def test_numbers_that_are_too_far_apart_are_an_error():
    near, far = torch.full((99,), 0.01), torch.tensor([5.0])
    assert "error" not in gpu_check._differences([(torch.cat([near, far]), torch.tensor(0.001))])
    assert gpu_check._differences([(torch.cat([near, far, far]), torch.tensor(0.001))])["error"] == "differs too much"
    assert gpu_check._differences([(near, torch.tensor(0.5))])["error"] == "differs too much"
    assert (
        gpu_check._differences([(torch.full((99,), math.nan), torch.tensor(math.nan))])["error"] == "differs too much"
    )


def test_a_part_that_fails_does_not_end_the_others(monkeypatch, tmp_path, capsys):
    def fail():
        raise gpu_check.CheckFailed("CUDA error: an illegal memory access was encountered")

    monkeypatch.setattr(gpu_check, "run_tests", fail)
    monkeypatch.setattr(gpu_check, "compare_all", lambda device, models: f"{device} with {models}")
    monkeypatch.setattr(gpu_check, "train", lambda device: "Losses of demo: 9, 8.")
    monkeypatch.setattr(gpu_check, "bench", lambda device, models: "| model |")
    out = tmp_path / "report.md"
    assert gpu_check.main(["--device", "cpu", "--model", "demo", "--out", str(out)]) == 1
    text = out.read_text()
    assert "## tests: FAILED\n\nCUDA error: an illegal memory access was encountered\n" in text
    assert "## CPU and GPU compared: passed\n\ncpu with ('demo',)\n" in text
    assert text.count(": passed\n") == 3
    assert "failed: tests" in capsys.readouterr().out


def test_a_process_that_fails_or_hangs_is_reported(monkeypatch):
    with pytest.raises(gpu_check.CheckFailed, match=r"a: exit code 3\n\n```\nout of memory\n```"):
        gpu_check._run(["sh", "-c", "echo out of memory >&2; exit 3"], "a")
    monkeypatch.setattr(gpu_check, "LIMIT_S", 0.1)
    with pytest.raises(gpu_check.CheckFailed, match=r"b: not done after 0\.1 s"):
        gpu_check._run(["sleep", "5"], "b")


@pytest.mark.slow
def test_the_whole_check_on_the_cpu(small_model_file, tmp_path, monkeypatch):
    """As on a GPU, with a small model; `train` too."""
    monkeypatch.setattr(gpu_check, "run_tests", lambda: "`1 passed`")
    monkeypatch.setattr(gpu_check, "PRECISIONS", ("fp32",))
    monkeypatch.setattr(gpu_check, "BENCH_FRAMES", 1)
    monkeypatch.setattr(gpu_check, "train", lambda device, train=gpu_check.train: train(device, str(small_model_file)))
    out = tmp_path / "report.md"
    assert gpu_check.main(["--device", "cpu", "--model", str(small_model_file), "--out", str(out)]) == 0, (
        out.read_text()
    )
    assert "FAILED" not in out.read_text()
