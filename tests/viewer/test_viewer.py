"""The native viewer without a screen; and a live view that cannot slow a run down."""

import os
import signal
import socket
import subprocess
import sys
import time

import cv2
import numpy as np
import pytest
from memory_drive import MemoryDrive
from recorded_drive import NamedModel, predict, record, screenshot_or_skip

from bevcli.errors import InputError, OutputError
from bevcli.recording import RecordingOptions
from bevcli.recording.writer import Recording
from bevcli.viewer import rerun_viewer
from bevcli.viewer.recording_reader import RecordingReader
from bevcli.viewer.rerun_viewer import LOOPBACK, NO_DRIVER, LiveView, free_port, start_viewer, stop, take_screenshot

VIEWS = {
    "3D scene", "BEV", "BEV features", "History weight", "Speed", "Seconds per stage", "Boxes per class", "Legend",
    "Events", "About",
    "CAM_FRONT", "CAM_FRONT_LEFT", "CAM_FRONT_RIGHT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_BACK_RIGHT",
}  # fmt: skip


@pytest.fixture(scope="module")
def screenshot(tmp_path_factory):
    folder = tmp_path_factory.mktemp("viewer")
    record(folder / "recording.rrd", MemoryDrive(3))
    views = screenshot_or_skip(folder / "recording.rrd", folder / "image.png", 1)
    return views, cv2.imread(str(folder / "image.png")), folder


@pytest.mark.slow
def test_the_viewer_shows_every_view(screenshot):
    views, image, _ = screenshot
    assert set(views) == VIEWS
    height, width = image.shape[:2]
    assert width >= 1280
    for place in ((0.15, 0.12), (0.15, 0.38), (0.15, 0.64), (0.85, 0.12), (0.85, 0.38), (0.85, 0.64)):
        row, column = round(place[0] * height), round(place[1] * width)
        assert image[row - 20 : row + 20, column - 20 : column + 20].std() > 10, f"no image at {place}"
    middle = image[height // 3 : 2 * height // 3]
    assert ((np.abs(middle.astype(int) - [250, 200, 90]).sum(-1) < 40).sum()) > 20  # the blue vehicle
    assert ((np.abs(middle.astype(int) - [44, 158, 255]).sum(-1) < 40).sum()) > 20  # the orange car


@pytest.mark.slow
def test_a_screenshot_can_be_a_jpeg_of_a_video_recording(screenshot):
    pytest.importorskip("av")
    *_, folder = screenshot
    record(folder / "av1.rrd", MemoryDrive(3), RecordingOptions(images="av1"))
    take_screenshot(folder / "av1.rrd", folder / "image.jpg", 2)
    assert (folder / "image.jpg").read_bytes().startswith(b"\xff\xd8\xff")
    image = cv2.imread(str(folder / "image.jpg"))
    height, width = image.shape[:2]
    assert image[height // 8 : height // 5, width // 10 : width // 5].std() > 10  # the viewer decodes AV1


def test_a_screenshot_needs_a_known_ending(tmp_path):
    with pytest.raises(InputError, match=r"must end in \.png, \.jpg or \.jpeg"):
        take_screenshot(tmp_path / "r.rrd", tmp_path / "image.webp")


class AnswersUntilItDraws:
    """The client of a viewer without a Vulkan driver, which ends when it first draws."""

    connect = classmethod(lambda cls, url: cls())

    def get_state(self):
        return None

    def take_screenshot(self):
        raise ConnectionError("transport error")

    def open(self, url):
        raise ConnectionError("transport error")


def test_without_vulkan_an_early_answer_changes_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr("rerun.experimental.ViewerClient", AnswersUntilItDraws)
    monkeypatch.setattr(rerun_viewer, "start_viewer", lambda *_: subprocess.Popen([sys.executable, "-c", ""]))
    with pytest.raises(OutputError, match="mesa-vulkan-drivers"):
        take_screenshot(tmp_path / "r.rrd", tmp_path / "image.png")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the viewer draws with Vulkan on Linux only")
def test_without_vulkan_each_try_names_the_driver(tmp_path, monkeypatch):
    record(tmp_path / "recording.rrd", MemoryDrive(1))
    for variable in ("VK_ICD_FILENAMES", "VK_DRIVER_FILES"):  # where the Vulkan loader looks for drivers
        monkeypatch.setenv(variable, str(tmp_path / "none.json"))
    for _ in range(10):
        with pytest.raises(OutputError) as error:
            take_screenshot(tmp_path / "recording.rrd", tmp_path / "image.png")
        assert str(error.value) == NO_DRIVER


@pytest.mark.slow
def test_a_screenshot_of_a_missing_frame_is_an_error(screenshot):
    *_, folder = screenshot
    with pytest.raises(InputError, match="3 frames from 0 to 2"):
        take_screenshot(folder / "recording.rrd", folder / "other.png", 7)


def test_a_port_in_use_is_not_free():
    with socket.socket() as taken:
        taken.bind((LOOPBACK, 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert free_port(port) != port


@pytest.mark.slow
@pytest.mark.parametrize("fate", [signal.SIGKILL, signal.SIGSTOP, signal.SIGTERM])
def test_a_viewer_that_dies_or_hangs_does_not_disturb_the_run(tmp_path, monkeypatch, fate):
    viewers: list[subprocess.Popen] = []

    def start_headless(*arguments: str) -> subprocess.Popen:
        viewers.append(start_viewer("--headless", *arguments))
        return viewers[-1]

    monkeypatch.setattr(rerun_viewer, "display_is_there", lambda: True)
    monkeypatch.setattr(rerun_viewer, "start_viewer", start_headless)
    drive = MemoryDrive(8)
    path = tmp_path / "recording.rrd"
    try:
        view = LiveView()
        with Recording(path, drive, NamedModel(), live=view) as recording:
            while not view.server.live_transfers:
                time.sleep(0.1)  # until the viewer is connected
            for place in range(8):
                if place == 3:
                    os.kill(viewers[0].pid, fate)
                frame = drive.load(place)
                recording.log(frame, predict(frame))  # must return, and not raise
    finally:
        os.kill(viewers[0].pid, signal.SIGCONT) if viewers[0].poll() is None else None
        stop(viewers[0])
    assert [frame.index for frame in RecordingReader(path).frames()] == list(range(8))
