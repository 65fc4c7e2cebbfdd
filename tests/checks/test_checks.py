"""What bevcli looks at before and while it runs."""

import json
import sys
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import MINI_TOML, command

from bevcli._version import __version__
from bevcli.sequences.open import open_sequence
from bevcli.workshop.benchmark import measure, versions
from bevcli.workshop.checks import commands as checks, torch_checks
from bevcli.workshop.checks.standing_check import StandingCheck


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


SAMPLE = Path(__file__).parents[2] / "samples/street"


def warned_at(frames) -> int | None:
    """The first frame, by its place, at which the images are said to move."""
    check = StandingCheck()
    return next((place for place, frame in enumerate(frames) if check.images_move(frame)), None)


def frames_of(path: Path, count: int):
    drive = open_sequence(path, ego_motion="static", ground_truth=False)
    return [drive.load(place) for place in range(min(count, len(drive.stamps)))]


@pytest.fixture(scope="module")
def street():
    """Nine frames of a vehicle that drives off, with two of its cameras."""
    two = ("CAM_FRONT", "CAM_BACK")
    return [replace(frame, images={name: frame.images[name] for name in two}) for frame in frames_of(SAMPLE, 9)]


def with_pixels(frame, change):
    images = {name: replace(image, pixels_bgr=change(name, image.pixels_bgr)) for name, image in frame.images.items()}
    return replace(frame, images=images)


@pytest.fixture(scope="module")
def standing(street):
    """The first frame again and again: a bus passes in each image, the light changes, and pixels are noisy."""
    random = np.random.default_rng(0)

    def seen(place):
        def change(name, pixels):
            height, width = pixels.shape[:2]
            start, bus = place * width // 8, street[place].images[name].pixels_bgr
            changed = pixels.copy()
            changed[height // 4 :, start : start + width // 3] = bus[height // 4 :, start : start + width // 3]
            noisy = changed * (0.9 + 0.02 * place) + random.integers(-8, 9, pixels.shape, np.int8)
            return noisy.clip(0, 255).astype(np.uint8)

        return change

    return [with_pixels(street[0], seen(place)) for place in range(len(street))]


def test_a_rendered_drive_moves(street):
    assert warned_at(street) in range(2, 8)
    assert warned_at([with_pixels(frame, lambda _, pixels: pixels[::2, ::2]) for frame in street]) in range(2, 8)


def test_other_road_users_do_not_move_the_vehicle(standing):
    assert warned_at(standing) is None
    lost = [replace(frame, images={}) if place in (0, 4) else frame for place, frame in enumerate(standing)]
    assert warned_at(lost) is None


def test_a_vehicle_that_drives_off_later_is_seen(street, standing):
    assert warned_at([*standing, *street[4:], *street[4:]]) is not None


def test_noise_and_darkness_say_nothing(street):
    random = np.random.default_rng(0)

    def noise(name, pixels):
        return random.integers(0, 255, pixels.shape, np.uint8)

    assert warned_at([with_pixels(frame, noise) for frame in street[:5]]) is None
    assert warned_at([with_pixels(frame, lambda _, pixels: pixels // 30) for frame in street]) is None
    assert warned_at([replace(frame, images={}) for frame in street]) is None


@pytest.mark.parametrize("name", ["kitti-straight", "nuscenes-scene-0103"])
def test_real_drives_move(name, shared):
    frames = frames_of(shared / "data" / name, 4)
    assert warned_at(frames) == 3
    assert warned_at([frames[0]] * 9) is None


def test_a_real_vehicle_that_stands_is_not_said_to_move(shared):
    drive = open_sequence(shared / "data/dgp-scene_01", ground_truth=False)
    assert drive.ego_motion.velocities == pytest.approx(0, abs=0.1)
    frames = [drive.load(place) for place in range(len(drive.stamps))]
    assert warned_at([*frames, *frames[::-1], *frames]) is None


@pytest.mark.parametrize("static", [("--static",), pytest.param(("--static", "--no-temporal"), marks=pytest.mark.slow)])
def test_a_run_advises_no_history(static, tmp_path):
    (tmp_path / "mini.toml").write_text(MINI_TOML)
    run = ("run", str(SAMPLE), "--model", "mini.toml", "--untrained", "--frames", "4:10", "--no-track")
    said = command(tmp_path, *run, *static).stderr
    warning = 'the images move as if the vehicle drove, but `ego_motion="static"` (`--static`) says that it stands'
    advice = "pass `odometry=True` (`--odometry`) in its place, which measures the motion, or `temporal=False`"
    assert (warning in said and advice in said) == (static == ("--static",))
