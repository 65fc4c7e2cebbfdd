"""Rerun's viewer as a process of ours: found in the installed package, on loopback only, telling nobody."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import rerun_cli  # type: ignore[import-untyped]

LOOPBACK = "127.0.0.1"
PORTS_TRIED = 20


def viewer_binary() -> Path:
    """The viewer itself. The console script is a wrapper in Python: ending it would leave the viewer running."""
    name = "rerun.exe" if sys.platform == "win32" else "rerun"
    return Path(rerun_cli.__file__).with_name(name)


def viewer_environment() -> dict[str, str]:
    """This process's environment, with the viewer's telemetry off (it sends none under CI)."""
    return {**os.environ, "CI": "1"}


def display_is_there() -> bool:
    """Whether a window could open."""
    if sys.platform in ("darwin", "win32"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def start_viewer(*arguments: str, quiet: bool = True) -> subprocess.Popen[bytes]:
    """Starts the viewer with command-line arguments, in the background. The caller ends it (`stop`)."""
    output = subprocess.DEVNULL if quiet else None
    command = [str(viewer_binary()), *arguments]
    return subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=output, stderr=output, env=viewer_environment())


def stop(process: subprocess.Popen[bytes]) -> None:
    """Ends a viewer as Ctrl-C would, so that it removes its temporary folder; at once if it does not listen."""
    if process.poll() is None:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(timeout=3)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def free_port(preferred: int | None = None, host: str = LOOPBACK) -> int:
    """A port that nobody uses: the preferred one or one of those after it, else any."""
    wanted = [] if preferred is None else range(preferred, preferred + PORTS_TRIED)
    for port in (*wanted, 0):
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((host, port))
            except OSError:
                continue
            return int(probe.getsockname()[1])
    raise AssertionError("the system gave no port at all")
