"""A run over thousands of frames takes no more memory, files, threads or sockets than one over a hundred."""

import gc
import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median

import cv2
import pytest
from memory_drive import MemoryDrive, make_camera

from bevcli.frame import CameraImage
from bevcli.geometry.cameras import CameraRig, default_ego_from_bev
from bevcli.inference.load import Model
from bevcli.model.bevformer.bevformer import BEVFormer
from bevcli.runs.options import RunOptions
from bevcli.runs.run_into_folder import run_in_folder
from bevcli.viewer.recording_file import open_recording
from bevcli.viewer.recording_reader import RecordingReader

MIB = 1 << 20
DESCRIPTORS = Path("/proc/self/fd")

pytestmark = pytest.mark.skipif(not DESCRIPTORS.exists(), reason="the process is measured on Linux")


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


@pytest.mark.slow
def test_memory_files_threads_and_sockets_stay_flat(mini_model, tmp_path):
    # An index would take 34 MB after these 100 frames; rerun's buffers come and go by up to 10 MB.
    assert_flat(measured_run(mini_model, tmp_path / "out", 120, range(20, 120, 10)), 14 * MIB, 14 * MIB)


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
