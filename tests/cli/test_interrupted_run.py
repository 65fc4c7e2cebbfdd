"""`bevcli run` that is killed, stopped, or runs out of disk: it loses no finished frame, and `--resume` goes on."""

import json
import os
import random
import shutil
import signal
import subprocess
import tempfile
import time
from pathlib import Path

import pytest
from command_line import MINI_TOML
from forks import FORKS, run_in_fork
from memory_drive import MemoryDrive
from small_fleet import RIG

from bevcli.sequences.files.boxes_file import read_boxes
from bevcli.viewer.recording_file import open_recording
from bevcli.viewer.recording_reader import RecordingReader
from bevcli.workshop.formats.output import NativeWriter

FRAMES = 40  # as many as a fast machine does not end before a signal
pytestmark = pytest.mark.usefixtures("unchecked_recordings")


class Run:
    """A process of `bevcli run drive`, whose texts go into a file."""

    def __init__(self, folder: Path, out: Path, *more: str, file_size: int | None = None) -> None:
        handle, name = tempfile.mkstemp(dir=folder, suffix=".txt")
        os.close(handle)
        self.texts = Path(name)
        self.process = FORKS.Process(target=run_in_fork, args=(folder, [*ARGUMENTS, str(out), *more], name, file_size))
        self.process.start()

    def end(self, seconds: float = 60) -> int:
        """The exit code."""
        self.process.join(seconds)
        assert self.process.exitcode is not None, self.printed
        return self.process.exitcode

    def signal(self, number: int) -> None:
        os.kill(self.process.pid, number)

    @property
    def printed(self) -> str:
        return self.texts.read_text()


ARGUMENTS = ["run", "drive", "--model", "mini.toml", "--untrained", "--rate", "all", "--out"]


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with a drive, a model and the folder `whole` of an uninterrupted run."""
    folder = tmp_path_factory.mktemp("interrupted")
    (folder / "mini.toml").write_text(MINI_TOML)
    sequence = MemoryDrive(FRAMES, RIG, scenes="a" * FRAMES)
    with NativeWriter(folder / "drive", with_ego_motion=True) as writer:
        for index in range(FRAMES):
            writer.write(sequence.load(index))
    complete(folder, folder / "whole")
    return folder


def complete(folder: Path, out: Path, *more: str) -> float:
    """Runs to the end; returns the seconds that this took."""
    began, run = time.monotonic(), Run(folder, out, *more)
    assert run.end() == 0, run.printed
    return time.monotonic() - began


def finished(out: Path) -> int:
    """The number of frames in predictions.json or its partial file; 0 without one."""
    files = [out / name for name in ("predictions.json", "predictions.json.partial")]
    if not any(file.exists() and file.stat().st_size for file in files):
        return 0
    return len(read_boxes(out / "predictions.json").frames)


def wait_for_frames(run: Run, out: Path, count: int) -> None:
    deadline = time.monotonic() + 60
    while run.process.is_alive() and time.monotonic() < deadline:
        if (out / "predictions.json.partial").exists() and finished(out) >= count:
            return
        time.sleep(0.01)
    raise AssertionError(f"the run ended before frame {count}: {run.printed}")


def frames_of_recording(path: Path) -> list[int]:
    with open_recording(path) as file:
        return [frame.index for frame in RecordingReader(file).frames()]


def assert_finished_frames_are_whole(out: Path, folder: Path) -> int:
    count = finished(out)
    whole = json.loads((folder / "whole/predictions.json").read_text())
    frames = read_boxes(out / "predictions.json").frames if count else ()
    assert [frame.stamp.index for frame in frames] == [row["frame"] for row in whole["frames"][:count]]
    if count:
        assert frames_of_recording(out / "recording.rrd")[:count] == list(range(count))
    return count


def assert_equals_whole(out: Path, folder: Path) -> None:
    for name in ("predictions.json", "tracks.csv"):
        assert (out / name).read_bytes() == (folder / "whole" / name).read_bytes()
    assert frames_of_recording(out / "recording.rrd") == list(range(FRAMES))


def test_a_signal_ends_a_run_after_its_frame_resume_completes_it(place):
    out, count = place / "signals", 0
    for number, code in ((signal.SIGTERM, 143), (signal.SIGINT, 130)):
        run, before = Run(place, out, "--resume"), count
        wait_for_frames(run, out, before + 2)
        run.signal(number)
        assert run.end(20) == code
        assert "Traceback" not in run.printed
        count = assert_finished_frames_are_whole(out, place)
        assert before + 2 <= count < FRAMES
        assert json.loads((out / "summary.json").read_text())["frames"] == count
    complete(place, out, "--resume")
    assert_equals_whole(out, place)


def test_a_second_signal_ends_the_run_at_once(place):
    out = place / "twice"
    run = Run(place, out)
    wait_for_frames(run, out, 1)
    run.signal(signal.SIGSTOP)  # both signals come within one frame
    for number in (signal.SIGTERM, signal.SIGINT):
        run.signal(number)
    run.signal(signal.SIGCONT)
    assert run.end(10) != 0


def slow(value):
    return pytest.param(value, marks=pytest.mark.slow)


def assert_fails_in_one_line(run: Run, *words: str) -> None:
    code = run.end()
    lines = [
        line for line in run.printed.splitlines() if not line.startswith(("note:", "warning:")) and "frames" not in line
    ]
    assert code == 1, run.printed
    assert len(lines) == 1, run.printed
    assert lines[0].startswith("error: ")
    assert all(word in lines[0] for word in words), run.printed


@pytest.mark.parametrize("limit", [slow(3_000), 100_000, slow(300_000), slow(600_000)])
def test_no_more_space_is_a_one_line_error_and_resume_goes_on(place, limit):
    out = place / f"limit-{limit}"
    assert_fails_in_one_line(Run(place, out, file_size=limit), "written")
    assert_finished_frames_are_whole(out, place)
    if limit == 300_000:
        complete(place, out, "--resume")
        assert_equals_whole(out, place)


def test_a_deleted_output_folder_is_an_error_of_one_line(place):
    out = place / "deleted"
    run = Run(place, out)
    wait_for_frames(run, out, 1)
    out.rename(place / "moved")
    subprocess.run(["rm", "-r", place / "moved"], check=False, timeout=10)
    assert_fails_in_one_line(run, "deleted")
    assert not out.exists()


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_hundred_kills_lose_no_finished_frame(place):
    """Kills at random moments, the first and the second after a frame.

    Every second run is resumed and killed again, the others start anew.
    """
    duration_s, randomness, found = complete(place, place / "timed"), random.Random(19), []
    for number in range(100):
        out, how = (place / "killed", "--force") if number % 2 else (place / "resumed", "--resume")
        run = Run(place, out, how)
        if number < 2:
            wait_for_frames(run, out, randomness.randrange(1, FRAMES // 2))
        else:
            run.process.join(randomness.uniform(0.2, 1.0) * duration_s)
        run.process.kill()
        run.process.join(10)
        found.append(assert_finished_frames_are_whole(out, place) if out.exists() else 0)
        if finished(out) == FRAMES:
            shutil.rmtree(out)
    assert max(found) > 0
    complete(place, place / "resumed", "--resume")
    assert_equals_whole(place / "resumed", place)
