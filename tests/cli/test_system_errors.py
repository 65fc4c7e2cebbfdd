"""What the system lacks or refuses is one line: memory, a package, an output stream, a disk."""

import marshal
import os
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import command, full_disk

from bevcli.cli import main
from bevcli.errors import OutputError
from bevcli.workshop.weights.model_file import convert

PROGRAM = [sys.executable, "-m", "bevcli"]


@pytest.mark.parametrize("streams", [">&-", "<&- >&- 2>&-"])
def test_closed_streams_are_null_devices(streams):
    """Else the next file that the program opens becomes its stdout."""
    done = subprocess.run(["sh", "-c", f'"$@" --version {streams}', "sh", *PROGRAM], capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (0, b"")


def test_a_reader_that_is_gone_before_the_first_byte_is_no_error():
    reader, writer = os.pipe()
    os.close(reader)
    try:
        done = subprocess.run([*PROGRAM, "--version"], stdout=writer, stderr=subprocess.PIPE, check=False)
    finally:
        os.close(writer)
    assert (done.returncode, done.stderr) == (0, b"")


def test_a_name_that_a_package_cannot_take_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr(main, "app", lambda: "drive\udcff".encode())
    monkeypatch.setattr(os, "_exit", sys.exit)
    done = command(tmp_path, "run")
    assert (done.returncode, done.stderr) == (1, "error: drive\\udcff: is not a name in UTF-8: rename it\n")


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        RuntimeError("can't start new thread"),
        Exception("(-4:Insufficient memory) Failed to allocate 691200 bytes"),
        OSError("libllvmlite.so: failed to map segment from shared object"),
        ImportError("libarrow.so.2600: failed to map segment from shared object"),
        RuntimeError("[enforce fail at alloc_cpu.cpp:117] DefaultCPUAllocator: can't allocate memory"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_a_lack_of_memory_is_one_line(error, tmp_path, monkeypatch):
    def fail():
        raise error

    monkeypatch.setattr(main, "app", fail)
    monkeypatch.setattr(os, "_exit", sys.exit)
    done = command(tmp_path, "run")
    assert done.returncode == 1
    assert done.stderr.startswith("error: the system gives no more memory or threads: ")
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.slow
def test_a_package_that_cannot_be_imported_is_one_line(tmp_path):
    environment = {**os.environ, "NUMBA_NUM_THREADS": "0"}
    run = [*PROGRAM, "render", "out", "--count", "1"]
    done = subprocess.run(run, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith("error: the package numba cannot be imported: ")
    assert len(done.stderr.splitlines()) == 1


def test_a_module_that_is_cut_off_is_one_line(tmp_path, monkeypatch):
    """As a full disk leaves it, by Python 3.11; typer prints "Aborted!" and nothing else."""
    monkeypatch.setattr(main._Group, "get_command", lambda *_: marshal.loads(b""))
    done = command(tmp_path, "checks")
    assert (done.returncode, len(done.stderr.splitlines())) == (1, 1)
    assert done.stderr.startswith("error: a file that is read ends too early (EOF read where object expected): ")


def test_other_errors_are_bugs_and_have_tracebacks(tmp_path, monkeypatch):
    def fail():
        raise KeyError("x")

    monkeypatch.setattr(main, "app", fail)
    with pytest.raises(KeyError):
        command(tmp_path, "run")


def test_weights_on_a_full_disk_are_one_line(tmp_path):
    demo = Path(main.__file__).parents[1] / "weights/demo.safetensors"
    with full_disk(10_000), pytest.raises(OutputError, match=r"out\.safetensors: cannot be written"):
        convert(demo, tmp_path / "out.safetensors")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_numba_without_its_compiler_is_one_line():
    code = "import bevcli.model.kernels.loops"
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert done.stderr.splitlines()[-1].startswith("bevcli.errors.BevcliError: NUMBA_DISABLE_JIT is set")
