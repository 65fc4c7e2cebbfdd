"""Starts and stops rerun's viewer as a child process, on loopback and without telemetry."""

import contextlib
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
    """The viewer's executable. The `rerun` command is a wrapper: stopping it would leave the viewer running."""
    name = "rerun.exe" if sys.platform == "win32" else "rerun"
    return Path(rerun_cli.__file__).with_name(name)


def viewer_environment() -> dict[str, str]:
    """The environment for the viewer: ours, and CI=1, which turns the viewer's telemetry off."""
    return {**os.environ, "CI": "1"}


def display_is_there() -> bool:
    """True if a window can be opened here."""
    has_display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    return sys.platform in ("darwin", "win32") or bool(has_display)


def start_viewer(*arguments: str) -> subprocess.Popen[bytes]:
    """Starts the viewer in the background with command-line arguments. The caller stops it with `stop`."""
    command, null = [str(viewer_binary()), *arguments], subprocess.DEVNULL
    return subprocess.Popen(command, stdin=null, stdout=null, stderr=null, env=viewer_environment())


def stop(process: subprocess.Popen[bytes]) -> None:
    """Stops a viewer like Ctrl-C, so that it removes its temporary folder; kills it if it runs on for 3 s."""
    if process.poll() is None:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(timeout=3)
        except subprocess.TimeoutExpired:
            process.kill()
            with contextlib.suppress(subprocess.TimeoutExpired):  # it hangs in the kernel: leave it
                process.wait(timeout=5)


def show_window(recording: Path) -> bool:
    """Open the viewer and wait until the user closes it. False if the viewer failed."""
    process = start_viewer("--bind", LOOPBACK, "--port", "auto", str(recording))
    try:
        return process.wait() == 0
    finally:
        stop(process)


def free_port(preferred: int | None = None, host: str = LOOPBACK) -> int:
    """A free port: the preferred one, or one of the 19 after it, or any other."""
    wanted = [] if preferred is None else range(preferred, preferred + PORTS_TRIED)
    for port in (*wanted, 0):
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((host, port))
            except OSError:
                continue
            return int(probe.getsockname()[1])
    raise AssertionError("the system has no free port")
