"""rerun's viewer as a child process, on loopback and without telemetry: in a window, or for a screenshot."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rerun_cli  # type: ignore[import-untyped]
from rerun.experimental import ViewerClient  # the only client that takes screenshots

from bevcli.errors import InputError, OutputError, WaitError
from bevcli.parsing.images import encode_image
from bevcli.recording import entities
from bevcli.viewer.recording_reader import RecordingReader
from bevcli.writing import write_whole

LOOPBACK = "127.0.0.1"
PORTS_TRIED = 20
START_TIMEOUT_S = 40.0
WHOLE_TIMEOUT_S = 180.0
ENDINGS = (".png", ".jpg", ".jpeg")
SETTLE_S = 2.5  # the viewer decodes images after it opened the views, and does not report when it is done
NO_DRIVER = (
    "the viewer cannot draw here: it needs a Vulkan driver (Debian, Ubuntu: apt-get install mesa-vulkan-drivers)"
)


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
        process.send_signal(signal.SIGTERM if sys.platform == "win32" else signal.SIGINT)
        try:
            process.wait(timeout=3)
        except subprocess.TimeoutExpired:
            process.kill()
            with contextlib.suppress(subprocess.TimeoutExpired):  # it hangs in the kernel: leave it
                process.wait(timeout=5)


def show_window(recording: Path, frame: int | None = None) -> bool:
    """Open the viewer and wait until the user closes it. False if the viewer failed.

    frame: index of the one that is shown first. Raises InputError if the recording does not have it.
    """
    port = "auto" if frame is None else str(free_port())
    process = start_viewer("--bind", LOOPBACK, "--port", port, str(recording))
    try:
        if frame is not None:
            client = _connect(process, int(port))
            _go_to(recording, client, _opened(process, client, NO_DRIVER), frame)
        return process.wait() == 0
    finally:
        stop(process)


def free_port(preferred: int | None = None, host: str = LOOPBACK) -> int:
    """A free port: the preferred one, or one of the 19 after it, or any other."""
    ports = [] if preferred is None else range(preferred, preferred + PORTS_TRIED)
    for port in (*ports, 0):
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((host, port))
            except OSError:
                continue
            return int(probe.getsockname()[1])
    raise AssertionError("the system has no free port")


def take_screenshot(recording: Path, image: Path, frame: int | None = None) -> tuple[str, ...]:
    """Writes an image of the whole viewer at a frame; returns the names of the views. Takes about 6 s.

    image: a .png, .jpg or .jpeg file. frame: the frame's index; None takes the first one.

    Raises OutputError if the viewer cannot draw (no Vulkan driver) or the file cannot be written, WaitError if the
    viewer hangs, and InputError if the file has another ending or the recording does not have the frame.
    """
    if image.suffix.lower() not in ENDINGS:
        raise InputError(f"{image}: the file must end in .png, .jpg or .jpeg")
    port, deadline = free_port(), time.monotonic() + WHOLE_TIMEOUT_S
    process = start_viewer("--headless", "--bind", LOOPBACK, "--port", str(port))
    # The client waits for the viewer without a limit; its calls fail when the viewer ends.
    limit = threading.Timer(WHOLE_TIMEOUT_S, process.kill)
    limit.daemon = True
    limit.start()
    try:
        client = _connect(process, port)
        client.open(str(recording))
        _go_to(recording, client, _opened(process, client, "the viewer cannot open the recording"), frame)
        time.sleep(SETTLE_S)
        _write(image, client.take_screenshot())
        return tuple(view.name for view in client.get_state().views)
    except (ConnectionError, RuntimeError) as error:
        if time.monotonic() >= deadline:
            raise WaitError(f"{recording}: the viewer has not drawn it within {WHOLE_TIMEOUT_S:.0f} s") from error
        raise OutputError(f"{recording}: the viewer failed while it drew the recording ({error}); try again") from error
    finally:
        limit.cancel()
        stop(process)


def _connect(process: subprocess.Popen[bytes], port: int) -> ViewerClient:
    for _ in _attempts(process):
        with contextlib.suppress(ConnectionError):
            client = ViewerClient.connect(f"rerun+http://{LOOPBACK}:{port}/proxy")
            client.take_screenshot()  # without a driver, the viewer answers other calls until it first draws, and ends
            return client
    raise OutputError(NO_DRIVER)


def _opened(process: subprocess.Popen[bytes], client: ViewerClient, failure: str) -> Any:
    """The state of the viewer once it shows a recording. failure: text of the OutputError if it never does."""
    for _ in _attempts(process):
        state = client.get_state()
        if state.recordings and state.recordings[0].timelines and state.views and not state.loading:
            return state
    raise OutputError(failure)


def _go_to(recording: Path, client: ViewerClient, state: Any, frame: int | None) -> None:
    timeline = next((t for t in state.recordings[0].timelines if t.name == entities.FRAME_TIMELINE), None)
    if timeline is None or timeline.start is None or timeline.end is None or timeline.time_type != "sequence":
        raise InputError(f"{recording}: the recording has no frames (expected one of `bevcli run`)")
    index = timeline.start if frame is None else frame
    RecordingReader(recording).check_frame(index)
    client.set_time(entities.FRAME_TIMELINE, sequence=index, play_state="paused")


def _attempts(process: subprocess.Popen[bytes]) -> Iterator[None]:
    """Yields about ten times a second while the viewer runs, for START_TIMEOUT_S."""
    deadline = time.monotonic() + START_TIMEOUT_S
    while time.monotonic() < deadline and process.poll() is None:
        yield
        time.sleep(0.1)


def _write(image: Path, png: bytes) -> None:
    if image.suffix.lower() != ".png":
        pixels = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
        assert pixels is not None
        png = encode_image(pixels)
    write_whole(image, png)
