"""Long runs: state files give back what was written, medians are right, and memory, files and threads stay few."""

import errno
import gc
import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, fields, replace
from pathlib import Path
from statistics import median
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from memory_drive import MemoryDrive, make_camera

from bevcli.errors import InputError, OutputError
from bevcli.frame import CameraImage, FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import CameraRig, default_ego_from_bev
from bevcli.geometry.transforms import Pose
from bevcli.inference.load import Model
from bevcli.inference.runner import RunnerState
from bevcli.model.bevformer import BEVFormer, BevHistory
from bevcli.runs import RunOptions
from bevcli.runs.run_into_folder import run_in_folder
from bevcli.runs.state import FORMAT, RunState, load_state, save_state
from bevcli.runs.summary import Counts, RunningMedian
from bevcli.viewer.recording_file import open_recording
from bevcli.viewer.recording_reader import RecordingReader
from bevcli.workshop.bevformer_v2 import FeatureWindow
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


class Hostile:
    def __reduce__(self):
        return os.mkdir, ("made",)


def test_nothing_in_a_file_is_called(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save_state(tmp_path / "state", FrameStamp(7, "", 5))
    for kind in (Pose, RunState[None]):  # a state of another type
        with pytest.raises(InputError, match="the state cannot be read"):
            load_state(tmp_path / "state", kind)
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
        with pytest.raises(InputError):
            load_state(tmp_path / "state", BevHistory)


def test_a_failed_write_keeps_the_state_before(tmp_path, monkeypatch):
    save_state(tmp_path / "state", 1)

    def full_disk(*arguments):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full_disk)
    with pytest.raises(OutputError):
        save_state(tmp_path / "state", 2)
    assert load_state(tmp_path / "state", int) == 1


@pytest.mark.parametrize("count", [1, 2, 3, 10, 1001, 20_000])
def test_the_median_is_right_to_half_a_per_cent(count):
    seconds = np.random.default_rng(count).lognormal(-2.0, 1.0, count)
    median = RunningMedian()
    assert median.value() == 0.0
    for value in seconds:
        median.add(float(value))
    expected = np.sort(seconds)[(count - 1) // 2]
    assert median.value() == pytest.approx(expected, rel=0.0051)
    assert median.count == count
    assert median.total_s == pytest.approx(seconds.sum())
    assert len(median.bins) < 1000  # from 1 µs to a quarter of an hour there are 2,070 bins


MIB = 1 << 20
DESCRIPTORS = Path("/proc/self/fd")


class SmallDrive(MemoryDrive):
    """A drive with two cameras, whose images are JPEG files of 96x54 pixels."""

    def __init__(self, count):
        cameras = make_camera("CAM_FRONT", 0, 96, 54), make_camera("CAM_BACK", 180, 96, 54)
        super().__init__(count, CameraRig(cameras, default_ego_from_bev()), scenes="a" * count)

    def load(self, place):
        frame = super().load(place)
        encoded = {name: cv2.imencode(".jpg", image.pixels_bgr)[1] for name, image in frame.images.items()}
        images = {
            name: CameraImage(image.timestamp_ns, image.pixels_bgr, encoded[name].tobytes(), "image/jpeg")
            for name, image in frame.images.items()
        }
        return replace(frame, images=images)


@dataclass(frozen=True)
class Usage:
    """What this process uses: bytes of memory, open files without sockets, sockets, threads."""

    memory: int
    files: int
    sockets: int
    threads: int


def usage() -> Usage:
    gc.collect()
    status = Path("/proc/self/status").read_text().split("VmRSS:")[1]
    links = []
    for entry in DESCRIPTORS.iterdir():
        try:
            links.append(os.readlink(entry))
        except FileNotFoundError:  # that of the listing itself
            continue
    sockets = sum(link.startswith("socket:") for link in links)
    threads = len(list(Path("/proc/self/task").iterdir()))
    return Usage(int(status.split()[0]) << 10, len(links) - sockets, sockets, threads)


def measured_run(mini_model, out: Path, frames: int, measured: range) -> list[Usage]:
    """Runs over a drive; the usage at each of the measured frames."""
    with run_in_folder(Model(mini_model), SmallDrive(frames), out, RunOptions()) as running:
        found = [usage() for frame, _ in running.frames if frame.stamp.index in measured]
    with open_recording(out / "recording.rrd") as file:
        assert file == out / "recording.rrd"
        indices = [frame.index for frame in RecordingReader(file).frames()]
    assert indices == list(range(frames))
    return found


def assert_flat(found: list[Usage], growth: int, peak: int) -> None:
    """growth, peak: bytes that the median of the last tenth, and any measurement, may be above the first ones."""
    first, tenth = found[0], max(1, len(found) // 10)
    memory = [each.memory for each in found]
    assert median(memory[-tenth:]) - median(memory[:tenth]) <= growth
    assert max(memory) - first.memory <= peak
    for name in ("files", "sockets", "threads"):
        # A few more for a moment: rerun closes a stream when the next one is open already.
        assert max(getattr(later, name) for later in found) <= getattr(first, name) + 3, name


@pytest.mark.skipif(not DESCRIPTORS.exists(), reason="the process is measured on Linux")
@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_ten_thousand_frames_take_the_memory_of_a_hundred(mini_config, tmp_path):
    """In a process of its own: one of many tests has freed memory that a long run may take or not."""
    encoder, decoder = (replace(part, layers=1) for part in (mini_config.encoder, mini_config.decoder))
    image = replace(mini_config.image, size=(48, 27))
    decoder = replace(decoder, queries=10, max_boxes=5)
    model = BEVFormer(replace(mini_config, image=image, encoder=encoder, decoder=decoder)).eval()
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        found = pool.submit(measured_run, model, tmp_path / "out", 10_000, range(100, 10_000, 50)).result()
    assert_flat(found, 20 * MIB, 120 * MIB)
