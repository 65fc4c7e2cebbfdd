"""`bevcli run` that is killed, stopped, or runs out of disk: it loses no finished frame, and `--resume` goes on."""

import json
import multiprocessing
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from memory_drive import MemorySequence
from test_run import MINI_TOML

from bevcli.cli.main import run_app
from bevcli.sequences.files.boxes_file import read_boxes
from bevcli.sequences.native.writer import NativeWriter
from bevcli.viewer.recording_file import open_recording
from bevcli.viewer.recording_reader import RecordingReader

FRAMES = 24
COMMAND = [sys.executable, "-m", "bevcli", "run", "drive", "--model", "mini.toml", "--untrained", "--rate", "all"]


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with a drive, a model and the folder `whole` of an uninterrupted run."""
    folder = tmp_path_factory.mktemp("interrupted")
    (folder / "mini.toml").write_text(MINI_TOML)
    sequence = MemorySequence(FRAMES, scenes="a" * FRAMES)
    with NativeWriter(folder / "drive", with_ego_motion=True) as writer:
        for index in range(FRAMES):
            writer.write(sequence.load(index))
    done = start(folder, "whole")
    assert done.wait(120) == 0, done.stderr.read()
    return folder


def start(folder, out, *more, **options) -> subprocess.Popen:
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(
        [*COMMAND, "--out", str(out), *more],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        **options,
    )


def finished(out: Path) -> int:
    """The number of frames in predictions.json or its partial file; 0 without one."""
    files = [out / name for name in ("predictions.json", "predictions.json.partial")]
    if not any(file.exists() and file.stat().st_size for file in files):
        return 0
    return len(read_boxes(out / "predictions.json").frames)


def wait_for_frames(process: subprocess.Popen, out: Path, count: int) -> None:
    deadline = time.monotonic() + 60
    while process.poll() is None and time.monotonic() < deadline:
        if (out / "predictions.json.partial").exists() and finished(out) >= count:
            return
        time.sleep(0.005)
    raise AssertionError(f"the run ended before frame {count}: {process.stderr.read()}")


def frames_of_recording(path: Path) -> list[int]:
    with open_recording(path) as file:
        return [frame.index for frame in RecordingReader(file.path).frames()]


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


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_signal_ends_the_run_after_its_frame_and_resume_completes_it(place, number, code):
    out = place / f"signal-{code}"
    process = start(place, out)
    wait_for_frames(process, out, 2)
    process.send_signal(number)
    _, printed = process.communicate(timeout=20)
    assert process.returncode == code
    assert "Traceback" not in printed
    count = assert_finished_frames_are_whole(out, place)
    assert 2 <= count < FRAMES
    assert json.loads((out / "summary.json").read_text())["frames"] == count
    again = start(place, out, "--resume")
    assert again.wait(60) == 0, again.stderr.read()
    assert_equals_whole(out, place)


def test_a_second_signal_ends_the_run_at_once(place):
    out = place / "twice"
    process = start(place, out)
    wait_for_frames(process, out, 1)
    os.kill(process.pid, signal.SIGSTOP)  # both signals come within one frame
    for number in (signal.SIGTERM, signal.SIGINT):
        process.send_signal(number)
    os.kill(process.pid, signal.SIGCONT)
    process.communicate(timeout=10)
    assert process.returncode != 0


def assert_fails_in_one_line(process: subprocess.Popen, *words: str) -> None:
    _, printed = process.communicate(timeout=60)
    lines = [
        line for line in printed.splitlines() if not line.startswith(("note:", "warning:")) and "frames" not in line
    ]
    assert process.returncode == 1, printed
    assert len(lines) == 1, printed
    assert lines[0].startswith("error: ")
    assert all(word in lines[0] for word in words), printed


@pytest.mark.parametrize("limit", [100, 3_000, 100_000, 600_000, 1_500_000])
def test_a_file_size_limit_is_an_error_of_one_line(place, limit):
    out = place / f"limit-{limit}"

    def limit_files():
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    assert_fails_in_one_line(start(place, out, preexec_fn=limit_files), "written")
    assert_finished_frames_are_whole(out, place)


@pytest.mark.parametrize("size", ["300k", "2m", "4m"])
def test_a_full_disk_is_an_error_of_one_line_and_resume_goes_on_with_more_space(place, size):
    disk = place / f"disk-{size}"
    disk.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "none", disk], check=False, timeout=10)
    if mounted.returncode != 0:
        pytest.skip("cannot mount a small file system here (needs root)")
    try:
        assert_fails_in_one_line(start(place, disk / "out"), "No space left on device")
        assert_finished_frames_are_whole(disk / "out", place)
        subprocess.run(["mount", "-o", "remount,size=100m", disk], check=True, timeout=10)
        again = start(place, disk / "out", "--resume")
        assert again.wait(60) == 0, again.stderr.read()
        assert_equals_whole(disk / "out", place)
    finally:
        subprocess.run(["umount", disk], check=True, timeout=10)


def test_a_deleted_output_folder_is_an_error_of_one_line(place):
    out = place / "deleted"
    process = start(place, out)
    wait_for_frames(process, out, 1)
    out.rename(place / "moved")
    subprocess.run(["rm", "-r", place / "moved"], check=False, timeout=10)
    assert_fails_in_one_line(process, "deleted")
    assert not out.exists()


# Runs that are killed start from a process that has imported everything, which takes most of the time of a short run.
FORKS = multiprocessing.get_context("forkserver")
FORKS.set_forkserver_preload(
    ["bevcli.cli.main", "bevcli.pipeline.run", "bevcli.recording.writer", "bevcli.sequences.open"]
)


def run_in_fork(folder: Path, arguments: list[str]) -> None:
    os.chdir(folder)
    with open(folder / "output.txt", "w") as output:
        os.dup2(output.fileno(), 1)
        os.dup2(output.fileno(), 2)
    sys.argv = arguments
    torch.set_num_threads(1)  # as `start`: the last bits of a result depend on the number of threads
    run_app()


def fork(folder: Path, out: Path, *more: str) -> multiprocessing.process.BaseProcess:
    process = FORKS.Process(target=run_in_fork, args=(folder, [*COMMAND[2:], "--out", str(out), *more]))
    process.start()
    return process


def complete(folder: Path, out: Path, *more: str) -> float:
    """Runs to the end; returns the seconds that this took."""
    began = time.monotonic()
    process = fork(folder, out, *more)
    process.join(60)
    assert process.exitcode == 0, (folder / "output.txt").read_text()
    return time.monotonic() - began


def check_kills(folder: Path, kills: int, name: str) -> None:
    """Kills at random moments: every second run is resumed and killed again, the others start anew."""
    randomness = random.Random(19)
    complete(folder, folder / f"{name}-timed")  # starts the server of the forks
    duration_s = complete(folder, folder / f"{name}-timed", "--force")
    found = []
    for number in range(kills):
        out, how = (folder / f"{name}-killed", "--force") if number % 2 else (folder / f"{name}-resumed", "--resume")
        process = fork(folder, out, how)
        process.join(randomness.uniform(0.2, 1.0) * duration_s)
        process.kill()
        process.join(10)
        found.append(assert_finished_frames_are_whole(out, folder) if out.exists() else 0)
        if finished(out) == FRAMES:
            shutil.rmtree(out)
    assert max(found) > 0
    complete(folder, folder / f"{name}-resumed", "--resume")
    assert_equals_whole(folder / f"{name}-resumed", folder)


def test_a_few_kills_lose_no_finished_frame(place):
    check_kills(place, 4, "few")


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_hundred_kills_lose_no_finished_frame(place):
    check_kills(place, 100, "many")
