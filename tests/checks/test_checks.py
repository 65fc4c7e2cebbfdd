"""`bevcli checks`: its facts are those of the machine, it names no user, and nothing makes it fail."""

import json
import sys
from importlib.metadata import version

import pytest
import torch
from command_line import MINI_TOML, command

from bevcli._version import __version__
from bevcli.workshop.benchmark import measure, versions
from bevcli.workshop.checks import commands as checks, torch_checks


def test_the_text_fits_a_screen_and_names_no_user(tmp_path, monkeypatch):
    home = tmp_path / "alice"
    (home / ".cache/bevcli/weights").mkdir(parents=True)
    (home / ".cache/bevcli/weights/file").write_bytes(bytes(3_000_000))
    (tmp_path / "disk/alice/numba").mkdir(parents=True)
    for name in ("XDG_CACHE_HOME", "HF_HOME", "HF_HUB_CACHE", "BEVCLI_WEIGHTS_DIR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.setenv("LOGNAME", "alice")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "disk/alice/numba"))
    done = command(tmp_path, "checks")
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) < 40
    assert all(len(line) <= 80 or "numba" in line for line in lines)  # a path is not cut
    assert [line.split()[0] for line in lines if line[0] != " "] == list(checks.CHECKS)
    assert f"torch {version('torch')}" in done.stdout
    assert "~/.cache/bevcli 3 MB" in done.stdout
    assert "/disk/USER/numba (compiled loops) 0 MB" in " ".join(done.stdout.split())
    assert "alice" not in done.stdout.replace("pytest-of-alice", "")
    assert "cannot be told" not in done.stdout


def test_each_line_tells_its_own_failure(tmp_path, monkeypatch):
    def fails() -> str:
        raise OSError(5, "Input/output error", str(tmp_path))

    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.delitem(sys.modules, torch_checks.__name__)
    monkeypatch.delattr("bevcli.workshop.checks.torch_checks")
    monkeypatch.setitem(checks.CHECKS, "viewer", fails)
    done = command(tmp_path, "checks", "--json")
    assert done.returncode == 0
    facts = json.loads(done.stdout)
    assert list(facts) == list(checks.CHECKS)
    assert facts["processor"].startswith("cannot be told (ModuleNotFoundError: ")
    assert facts["viewer"].startswith("cannot be told (OSError: [Errno 5]")
    assert facts["bevcli"].startswith(f"{__version__} of a checkout")


def test_metadata_of_another_version_are_told(monkeypatch):
    monkeypatch.setattr(checks, "installed", lambda package: "0.0.1")
    assert f"{__version__} of a checkout (its metadata are of 0.0.1: install it again), Python" in checks.versions()
    monkeypatch.setattr(checks, "installed", lambda package: __version__)
    assert f"{__version__} of a checkout, Python" in checks.versions()


def test_what_is_not_installed_and_how_to(monkeypatch):
    stated = [
        "torch>=2",
        "none-a>=1; extra == 'fog'",
        'none_b; extra == "fog"',
        "torch; extra == 'rain'",
        "x; extra == 'dev'",
    ]
    monkeypatch.setattr(checks, "requires", lambda name: stated)
    assert checks.missing() == {"fog": "pip install 'bevcli[fog]' (none-a, none_b)"}
    assert checks.packages() == {"torch": version("torch")}
    monkeypatch.setattr(checks, "requires", lambda name: [*stated, "gone>=2"])
    assert checks.packages()["gone"] == "NOT INSTALLED"


def test_the_kernels_are_those_that_a_model_gets(monkeypatch):
    if not torch.ops.mkldnn._is_mkldnn_bf16_supported():
        pytest.skip("the processor has no instructions for bfloat16")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.cpu, "_is_amx_tile_supported", lambda: True)
    found = torch_checks.kernels()
    assert "CompiledSampling" in found["attention"]
    assert found["bf16"] == "for images and products of encoder and decoder (AMX)"
    monkeypatch.setattr(torch.cpu, "_is_amx_tile_supported", lambda: False)
    assert torch_checks.kernels()["bf16"] == "for images only (no AMX)"


@pytest.mark.slow
def test_speed_measures_each_model_until_the_time_is_over(tmp_path, monkeypatch):
    (tmp_path / "mini.toml").write_text(MINI_TOML)
    for name in ("WIDTH", "HEIGHT", "FOCAL_LENGTH", "BACK_FOCAL_LENGTH"):
        monkeypatch.setattr(versions, name, getattr(versions, name) // 4)
    monkeypatch.setattr(measure, "CPU_EDGE", 256)
    monkeypatch.setattr(measure, "COPIED_FLOATS", 1 << 20)
    monkeypatch.setattr(measure, "MODELS", (str(tmp_path / "mini.toml"),))
    monkeypatch.setattr(measure, "FRAMES", 2)
    rows = list(measure.measure_speed().values())
    assert "GB/s" in rows[0]
    assert rows[1].endswith("2 frames)")
    assert rows[2].endswith("2 frames)")
    monkeypatch.setattr(measure, "BUDGET_S", -1.0)
    assert list(measure.measure_speed().values())[1:3] == ["not measured: the minute is over"] * 2
