"""A process that runs fuzz cases, with limits on time and memory; what it cannot survive ends only the process."""

from __future__ import annotations

import logging
import multiprocessing.process
import os
import resource
import shutil
import tempfile
import traceback
import warnings
from collections.abc import Callable
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from random import Random
from typing import TYPE_CHECKING

from forks import FORKS

if TYPE_CHECKING:
    from readers import Reader

SECONDS = 10.0
MEMORY = 1 << 30  # bytes beyond what the libraries and the seed files take
START_SECONDS = 240.0


class Worker:
    """Runs cases, one after the other, in another process, which is replaced where a case ends it.

    seeds: the folder of seed files; each process works in a copy beside it, which `close` deletes: a process that is
    killed cannot. group: of `groups.GROUPS`, run in place of the readers.
    """

    def __init__(self, seeds: Path, group: str | None = None) -> None:
        self._seeds, self._group = seeds, group
        self._process: multiprocessing.process.BaseProcess | None = None
        self._connection: Connection | None = None

    def run(self, name: str, case: bytes | int) -> str:
        """What comes of a case: "read", "refused: …" (one BevcliError), or what went wrong.

        name: of a reader, whose file then holds the bytes; or of a group, whose case has this number.
        """
        if self._process is None or not self._process.is_alive():
            self.close()
            self._start()
        assert self._connection is not None
        try:
            self._connection.send((name, case))
            if self._connection.poll(SECONDS):
                return self._connection.recv()
            answer = f"hang: more than {SECONDS:.0f} s"
        except (EOFError, ConnectionError):
            answer = "crash: the process died"
        self.close()
        return answer

    def close(self) -> None:
        """Ends the process, and deletes its folder."""
        if self._process is not None:
            self._process.kill()
            self._process.join()
            self._process = None
            shutil.rmtree(self._folder, ignore_errors=True)  # what it started may live a little longer

    def _start(self) -> None:
        self._connection, other = FORKS.Pipe()
        self._folder = Path(tempfile.mkdtemp(prefix="fuzz-", dir=self._seeds.parent))
        given = other, self._seeds, self._folder, self._group
        self._process = FORKS.Process(target=_serve, args=given, daemon=True)
        self._process.start()
        other.close()
        if not self._connection.poll(START_SECONDS):
            raise RuntimeError("the fuzz worker does not start")
        answer = self._connection.recv()
        assert answer == "ready", answer


def _serve(connection: Connection, seeds: Path, folder: Path, group: str | None) -> None:
    from readers import READERS
    from warm_python import WarmPython

    from bevcli.viewer import recording_file
    from bevcli.workshop import meshes

    recording_file.run_python = meshes.run_python = WarmPython()  # ends with this process, as its input does
    warnings.simplefilter("ignore")
    logging.disable()
    own, case = folder / "files", folder / "case"
    shutil.copytree(seeds, own)
    os.environ |= {"XDG_CACHE_HOME": str(folder), "TMPDIR": str(folder)}
    os.chdir(folder)
    with open(os.devnull, "w") as silent:  # FFmpeg and libpng complain there about every broken file
        os.dup2(silent.fileno(), 2)
    try:
        runs: dict[str, Callable[..., None]]
        if group is not None:
            runs = {group: _group_run(group, own, case)}
            _outcome(partial(runs[group], 0), 0)  # makes what all cases share
        else:
            runs = {name: partial(_read, reader, own) for name, reader in READERS.items()}
            for reader in READERS.values():
                reader.read(own)
    except BaseException:
        connection.send(traceback.format_exc())
        raise
    limit = _bytes_of("VmSize") + 4 * MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    base = _bytes_of("VmRSS")
    connection.send("ready")
    while True:
        name, given = connection.recv()
        Path("/proc/self/clear_refs").write_text("5")  # the peak is measured from now on
        connection.send(_outcome(partial(runs[name], given), base))


def _read(reader: Reader, own: Path, data: bytes) -> None:
    """Reads the seed files with other contents of one of them."""
    file = own / reader.file
    whole = file.read_bytes()
    try:
        file.write_bytes(data)
        reader.read(own)
    finally:
        file.write_bytes(whole)


def _group_run(name: str, own: Path, case: Path) -> Callable[[int], None]:
    from groups import GROUPS

    def run(number: int) -> None:
        shutil.rmtree(case, ignore_errors=True)
        case.mkdir()
        GROUPS[name].run(own, case, Random(f"{name} {number}"))

    return run


def _outcome(run: Callable[[], None], base: int) -> str:
    from bevcli.errors import BevcliError

    try:
        run()
        answer = "read"
    except BevcliError as error:
        answer = f"refused: {error}" if "\n" not in str(error) else f"several lines: {error}"
    except BaseException:
        answer = traceback.format_exc()
    grown = _bytes_of("VmHWM") - base
    return answer if grown <= MEMORY else f"memory: {grown >> 20} MiB more than before; {answer}"


def _bytes_of(name: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{name}:"):
            return int(line.split()[1]) << 10
    raise KeyError(name)
