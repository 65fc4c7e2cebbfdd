"""State files give back what was written, bit by bit, and run nothing."""

import errno
import os
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from bevcli.errors import InputError, OutputError
from bevcli.frame import FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Pose
from bevcli.inference.runner import RunnerState
from bevcli.model.bevformer.bevformer import BevHistory
from bevcli.runs.state import FORMAT, RunState, load_state, save_state
from bevcli.runs.summary import Counts
from bevcli.workshop.bevformer_v2.window import FeatureWindow
from bevcli.workshop.uniad.uniad import TrackMemory


def assert_same(one, other):
    assert type(one) is type(other)
    if isinstance(one, torch.Tensor):
        assert one.dtype == other.dtype
        assert torch.equal(one, other)
    elif isinstance(one, np.ndarray):
        np.testing.assert_array_equal(one, other, strict=True)
    elif isinstance(one, (tuple, list)):
        assert len(one) == len(other)
        for a, b in zip(one, other, strict=True):
            assert_same(a, b)
    elif isinstance(one, dict):
        assert_same(tuple(one.items()), tuple(other.items()))
    elif hasattr(one, "__dataclass_fields__"):
        for field in fields(one):
            assert_same(getattr(one, field.name), getattr(other, field.name))
    else:
        assert one == other


@dataclass(frozen=True)
class Plain:
    numbers: dict[int, float | None]
    items: list[bool | float | int]
    empty: tuple[()]
    words: np.ndarray[Any, np.dtype[np.str_]]
    rows: np.ndarray[Any, np.dtype[np.float64]]
    half: torch.Tensor
    scalar: torch.Tensor


def test_a_state_comes_back_exactly(tmp_path):
    pose = Pose(np.array([1 / 3, -2.0, 1e300]), np.array([-1.0, 0, 0, 0]))
    stamp = FrameStamp(7, "straße", 1_533_151_603_547_590_001)
    half = torch.randn(3, 2).to(torch.bfloat16).T
    items = [True, 0.1, float("inf"), -(10**18)]
    plain = Plain({1: 0.5, 3: None}, items, (), np.array(["car", "bus"]), np.zeros((0, 3)), half, torch.tensor(5))
    for state in (BevHistory(torch.randn(1, 12, 4), pose), stamp, plain, Boxes3D.empty()):
        save_state(tmp_path / "state", state)
        assert_same(load_state(tmp_path / "state", type(state)), state)


@pytest.mark.parametrize("memory", [BevHistory, FeatureWindow, TrackMemory])
def test_a_run_state_takes_the_memory_of_its_model(tmp_path, memory):
    none: RunState[None] = RunState({"model": "mini"}, None, Counts(), RunnerState(stamp=FrameStamp(2, "", 5)))
    save_state(tmp_path / "state", none)
    assert load_state(tmp_path / "state", RunState[memory]) == none


def test_a_state_of_another_type_is_refused(tmp_path):
    save_state(tmp_path / "state", FrameStamp(7, "", 5))
    for kind in (Pose, RunState[None]):
        with pytest.raises(InputError, match="the state cannot be read"):
            load_state(tmp_path / "state", kind)


class Hostile:
    def __reduce__(self):
        return os.mkdir, ("made",)


def test_nothing_in_a_file_is_called(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save_state(tmp_path / "state", FrameStamp(Hostile(), "", 5))
    with pytest.raises(InputError, match="the state cannot be read"):
        load_state(tmp_path / "state", FrameStamp)
    assert not (tmp_path / "made").exists()


@pytest.mark.parametrize("content", [b"", b"nothing", b"bevcli-state/8", FORMAT, FORMAT + bytes(32)])
def test_another_file_is_an_error_of_one_line(tmp_path, content):
    (tmp_path / "state").write_bytes(content)
    with pytest.raises(InputError, match="state"):
        load_state(tmp_path / "state", BevHistory)


def test_a_state_with_one_changed_byte_is_refused(tmp_path):
    save_state(tmp_path / "state", BevHistory(torch.arange(4.0), Pose.identity()))
    whole = (tmp_path / "state").read_bytes()
    for place in range(0, len(whole), 7):
        broken = bytearray(whole)
        broken[place] ^= 1
        (tmp_path / "state").write_bytes(broken)
        with pytest.raises(InputError) as error:
            load_state(tmp_path / "state", BevHistory)
        assert "\n" not in str(error.value)


def test_a_failed_write_keeps_the_state_before(tmp_path, monkeypatch):
    save_state(tmp_path / "state", 1)

    def full_disk(*arguments):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full_disk)
    with pytest.raises(OutputError):
        save_state(tmp_path / "state", 2)
    assert load_state(tmp_path / "state", int) == 1
