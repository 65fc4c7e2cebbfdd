"""Screenshots of a recording in the viewer, which runs without a screen and draws with Vulkan."""

import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from rerun.experimental import ViewerClient
from rerun.experimental._viewer_client import ViewerState

from bevcli.errors import InputError, OutputError, WaitError
from bevcli.recording import entities
from bevcli.viewer.native import LOOPBACK, free_port, start_viewer, stop
from bevcli.writing import write_whole

Answer = TypeVar("Answer")
START_TIMEOUT_S = 40.0
WHOLE_TIMEOUT_S = 180.0
ENDINGS = (".png", ".jpg", ".jpeg")
JPEG_QUALITY = 90
SETTLE_S = 2.5  # the viewer decodes images after it opened the views, and does not report when it is done
NO_DRIVER = (
    "the viewer cannot draw here: it needs a Vulkan driver (Debian, Ubuntu: apt-get install mesa-vulkan-drivers)"
)


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
        state = _wait(process, lambda: _opened(client), "the viewer cannot open the recording")
        _go_to(recording, client, state, frame)
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
    def answer() -> ViewerClient | None:
        try:
            client = ViewerClient.connect(f"rerun+http://{LOOPBACK}:{port}/proxy")
            client.take_screenshot()  # without a driver, the viewer answers other calls until it first draws, and ends
        except ConnectionError:
            return None
        return client

    return _wait(process, answer, NO_DRIVER)


def _opened(client: ViewerClient) -> ViewerState | None:
    state = client.get_state()
    ready = state.recordings and state.recordings[0].timelines and state.views and not state.loading
    return state if ready else None


def _go_to(recording: Path, client: ViewerClient, state: ViewerState, frame: int | None) -> None:
    timeline = next((t for t in state.recordings[0].timelines if t.name == entities.FRAME_TIMELINE), None)
    if timeline is None or timeline.start is None or timeline.end is None or timeline.time_type != "sequence":
        raise InputError(f"{recording}: the recording has no frames (expected one of `bevcli run`)")
    wanted = timeline.start if frame is None else frame
    if not timeline.start <= wanted <= timeline.end:
        raise InputError(f"{recording}: `frame={wanted}`: the recording has frames {timeline.start} to {timeline.end}")
    client.set_time(entities.FRAME_TIMELINE, sequence=wanted, play_state="paused")


def _wait(process: subprocess.Popen[bytes], attempt: Callable[[], Answer | None], failure: str) -> Answer:
    deadline = time.monotonic() + START_TIMEOUT_S
    while time.monotonic() < deadline and process.poll() is None:
        result = attempt()
        if result is not None:
            return result
        time.sleep(0.1)
    raise OutputError(failure)


def _write(image: Path, png: bytes) -> None:
    if image.suffix.lower() != ".png":
        pixels = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
        assert pixels is not None
        png = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
    write_whole(image, png)
