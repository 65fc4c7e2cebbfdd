"""Processes that share out work give the same, in the same order, as one; their ends and errors are errors here."""

import os
import signal
import subprocess
import sys
import time
from functools import partial

import pytest

from bevcli.errors import InputError, OutputError
from bevcli.workshop.synth.drive import render
from bevcli.workshop.synth.workers import shared_out


def refuse(index):
    raise InputError(f"no {index}")


@pytest.mark.parametrize("count", [1, 11])
def test_items_of_two_processes_come_in_order(count):
    with shared_out(partial(map, str), count, 2) as items:
        assert list(items) == [str(index) for index in range(count)]


@pytest.mark.parametrize(
    ("make", "kind", "message"), [(os._exit, OutputError, "ended early"), (refuse, InputError, "no 0")]
)
def test_errors_of_a_process_are_raised(make, kind, message):
    with shared_out(partial(map, make), 1, 1) as items, pytest.raises(kind, match=message):
        next(items)


@pytest.mark.slow
def test_two_workers_write_the_files_of_one(tmp_path):
    for workers in (1, 2):
        render(tmp_path / str(workers), seed=5, frames=5, resolution=(160, 90), workers=workers)
    one, two = (
        {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
        for folder in (tmp_path / "1", tmp_path / "2")
    )
    assert one == two


@pytest.mark.slow
def test_ctrl_c_ends_the_workers_and_leaves_no_drive(tmp_path):
    options = ["--count", "60", "--workers", "2", "--resolution", "160x90"]
    command = [sys.executable, "-m", "bevcli", "render", tmp_path / "out", *options]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)
    while not list(tmp_path.glob("out/images/*/000002.jpg")):
        time.sleep(0.1)
    os.killpg(process.pid, signal.SIGINT)
    assert "Traceback" not in process.communicate()[1]  # returns when no worker holds the pipe any more
    assert process.returncode == 130
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
