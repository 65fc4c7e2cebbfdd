"""`run_python` without its imports, which take a second: each program is a fork of one process that has made them."""

import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from select import select

from bevcli.parsing.files import LIMIT_MEMORY
from bevcli.viewer.recording_file import CHECK_ENVIRONMENT

# A child ends as `python -P -c CODE …` does, but without the interpreter's own end.
SERVER = """
import gc, json, os, sys, traceback
import rerun.chunk, bevcli.workshop.meshes, trimesh

def end_of(code):
    try:
        exec(code, {"__name__": "__main__"})
    except SystemExit as end:
        if isinstance(end.code, str):
            print(end.code, file=sys.stderr)
        return 1 if isinstance(end.code, str) else end.code or 0
    except BaseException:
        traceback.print_exc()
        return 1
    return 0

gc.freeze()
while request := sys.stdin.readline():
    code, arguments, environment, folder, streams = json.loads(request)
    child = os.fork()
    if not child:
        os.chdir(folder)
        for number, name in enumerate(streams):
            os.dup2(os.open(name, os.O_RDWR), number)
        os.environ.clear()
        os.environ.update(environment)
        sys.argv = ["-c", *arguments]
        number = end_of(code)
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(number)
    print(child, flush=True)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""


class WarmPython:
    """Takes the place of `run_python`. The process starts with the first program and ends with `close`."""

    def __init__(self) -> None:
        self._server: subprocess.Popen[bytes] | None = None

    def __call__(
        self,
        code: str,
        arguments: Sequence[object],
        memory: int,
        seconds: float,
        environment: Mapping[str, str] = os.environ,
    ) -> subprocess.CompletedProcess[bytes]:
        if self._server is None or self._server.poll() is not None:
            self._server = _start()
        words = [*map(str, arguments)]
        with tempfile.TemporaryDirectory() as folder:
            out, err = (Path(folder) / name for name in ("out", "err"))
            out.touch()
            err.touch()
            streams = [os.devnull, str(out), str(err)]
            program = LIMIT_MEMORY.format(memory=memory) + code
            request = json.dumps([program, words, dict(environment), os.getcwd(), streams])
            self._server.stdin.write(request.encode() + b"\n")
            child = int(self._server.stdout.readline())
            late = not select([self._server.stdout], [], [], seconds)[0]
            if late:
                os.kill(child, signal.SIGKILL)
            number = int(self._server.stdout.readline())
            if late:
                raise subprocess.TimeoutExpired(words, seconds)
            return subprocess.CompletedProcess(words, number, out.read_bytes(), err.read_bytes())

    def close(self) -> None:
        if self._server is not None:
            self._server.communicate(timeout=10)  # it ends where its input ends


def _start() -> subprocess.Popen[bytes]:
    environment = {**os.environ, **CHECK_ENVIRONMENT, "RUST_BACKTRACE": "0", "OPENBLAS_NUM_THREADS": "1"}
    environment["PYTHONPATH"] = os.pathsep.join(sys.path)
    command, pipe = [sys.executable, "-P", "-c", SERVER], subprocess.PIPE
    # Without a buffer, which would hide from `select` what it holds.
    return subprocess.Popen(command, stdin=pipe, stdout=pipe, bufsize=0, env=environment)
