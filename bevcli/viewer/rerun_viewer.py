"""rerun's viewer without telemetry: as a child process in a window or for a screenshot, and in a browser.

Rerun's own web server (0.41) answers pages of other names that lead here (DNS rebinding), links fonts of Google, needs
two ports, and keeps a third of a core busy while nobody looks. `WebViewer` takes the files of the web viewer from the
installed viewer once, and serves them and the recording from one origin. A content security policy lets the pages
connect to that origin only; so the viewer in the browser cannot send telemetry.
"""

from __future__ import annotations

import contextlib
import ipaddress
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, quote, urlsplit

import cv2
import numpy as np
import rerun_cli  # type: ignore[import-untyped]
from rerun.experimental import ViewerClient  # the only client that takes screenshots

from bevcli.errors import InputError, OutputError, WaitError
from bevcli.parsing.files import open_regular
from bevcli.parsing.images import encode_image
from bevcli.printing import say
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
# In a browser.
ASSETS = {
    "/": "text/html; charset=utf-8",
    "/re_viewer.js": "text/javascript",
    "/re_viewer_bg.wasm": "application/wasm",
    "/favicon.ico": "image/x-icon",
}
RECORDING = "/recording.rrd"
WEB_TIMEOUT_S = 15.0
STOP_TIMEOUT_S = 5.0
CONNECTION_TIMEOUT_S = 60.0
GROWTH_PERIOD_S = 0.05  # between two looks at a file that is still written
BLOCK = 1 << 18  # bytes
FONT_LINKS = re.compile(rb"<link[^>]*https://fonts[^>]*>", re.DOTALL)  # links to Google's fonts; removed


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


def web_viewer_assets() -> dict[str, bytes]:
    """The files of the web viewer by path, fetched from the installed viewer (43 MB, takes about a second)."""
    port = free_port()
    address = f"http://{LOOPBACK}:{port}"
    # With the address of a recording the viewer starts no second server. That recording is never requested.
    process = start_viewer("--serve-web", "--bind", LOOPBACK, "--web-viewer-port", str(port), f"{address}/none.rrd")
    try:
        files = {path: _fetch(address + path) for path in ASSETS}
    finally:
        stop(process)
    return {**files, "/": FONT_LINKS.sub(b"", files["/"])}


class WebViewer(ThreadingHTTPServer):
    """A web server for the viewer and a recording.

    The file is opened once, here: whatever takes its place later is not served. Each connection has a thread. A
    connection that breaks is no error.

    Args:
        assets: the web viewer's files by path (`web_viewer_assets`).
        recording: the .rrd file.
        host: the address to listen on.
        port: the preferred port; if it is in use, the next free one is taken.
        ended: set when the file has its last byte; until then, viewers get what is appended. None for a whole file.

    Attributes:
        live_transfers: threads that send a recording while it grows.
        last_block_s: time at which a viewer took the last block (time.monotonic()).

    Raises OutputError where the recording cannot be read, or is no file.
    """

    daemon_threads = True

    def __init__(
        self,
        assets: dict[str, bytes],
        recording: Path,
        host: str = LOOPBACK,
        port: int | None = 9090,
        *,
        ended: threading.Event | None = None,
    ) -> None:
        if ":" in host:
            self.address_family = socket.AF_INET6
        self.assets, self.file, self.ended = assets, open_regular(recording, error=OutputError), ended
        self.live_transfers: list[threading.Thread] = []
        self.last_block_s = 0.0
        self.host, self.port = host, free_port(port, host)
        super().__init__((self.host, self.port), _Handler)

    @property
    def address(self) -> str:
        """The address to open in a browser."""
        return f"http://{self.host}:{self.port}"

    def serve(self) -> None:
        """Serves until `close` is called from another thread."""
        self.serve_forever(poll_interval=1.0)

    def close(self) -> None:
        """Stops `serve`, and frees the port. Viewers that follow a recording and still read get its rest first."""
        # shutdown waits until `serve` has ended, without a limit.
        stopping = threading.Thread(target=self.shutdown, daemon=True)
        stopping.start()
        stopping.join(STOP_TIMEOUT_S)
        self.server_close()
        for transfer in self.live_transfers:
            while transfer.is_alive() and time.monotonic() - self.last_block_s < STOP_TIMEOUT_S:
                transfer.join(GROWTH_PERIOD_S)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Prints nothing if the browser has gone or is silent."""
        if not isinstance(sys.exception(), (ConnectionError, TimeoutError)):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    server: WebViewer
    protocol_version = "HTTP/1.1"
    timeout = CONNECTION_TIMEOUT_S  # of each read and write

    def do_GET(self) -> None:
        """Serves the viewer's files and the recording; "/" redirects to the viewer with the recording."""
        parts = urlsplit(self.path)
        if not _is_own_name(self.headers.get("Host", "")):
            self._send_head(403, "text/plain", 0)
        elif parts.path == RECORDING:
            self._send_recording()
        elif parts.path == "/" and "url" not in parse_qs(parts.query):
            self._redirect(parts.query)
        elif parts.path in self.server.assets:
            self._send_head(200, ASSETS[parts.path], len(self.server.assets[parts.path]))
            self.wfile.write(self.server.assets[parts.path])
        else:
            self._send_head(404, "text/plain", 0)

    def log_message(self, format: str, *arguments: object) -> None:
        """Logs nothing, so that the terminal stays readable."""

    def _redirect(self, query: str) -> None:
        url = f"http://{self.headers.get('Host', '')}{RECORDING}"
        self.send_response(302)
        # The labels of images and of the scene are unreadable in the light theme of a light browser.
        theme = "" if "theme" in parse_qs(query) else "&theme=dark"
        self.send_header("Location", f"/?url={quote(url, safe='')}{theme}" + (f"&{query}" if query else ""))
        self.send_header("Content-Length", "0")
        self.end_headers()

    def _send_recording(self) -> None:
        file, ended = self.server.file, self.server.ended
        size = os.fstat(file.fileno()).st_size
        if ended is None:
            self._send_head(200, "application/octet-stream", size)
            self._copy(0, size)
            return
        self.server.live_transfers.append(threading.current_thread())
        self.close_connection = True
        self._send_head(200, "application/octet-stream", None)
        sent, is_last = 0, False
        while not is_last:
            is_last = ended.wait(GROWTH_PERIOD_S)
            size = os.fstat(file.fileno()).st_size
            if size > sent:
                self.wfile.write(b"%x\r\n" % (size - sent))
                self._copy(sent, size)
                self.wfile.write(b"\r\n")
                sent = size
        self.wfile.write(b"0\r\n\r\n")

    def _copy(self, start: int, end: int) -> None:
        """Sends the bytes from start to end. Raises ConnectionError where the file is cut meanwhile."""
        while start < end:
            block = os.pread(self.server.file.fileno(), min(BLOCK, end - start), start)
            if not block:
                raise ConnectionError("the recording is shorter than it was")
            self.wfile.write(block)
            self.server.last_block_s = time.monotonic()
            start += len(block)

    def _send_head(self, status: int, media_type: str, length: int | None) -> None:
        """length: of the body in bytes; None for a body in chunks."""
        self.send_response(status)
        self.send_header("Content-Type", media_type)
        if length is None:
            self.send_header("Transfer-Encoding", "chunked")
        else:
            self.send_header("Content-Length", str(length))
        self.send_header("Content-Security-Policy", "connect-src 'self' blob: data:")
        self.end_headers()


def _is_own_name(host: str) -> bool:
    """True if a Host header names this machine: an IP address, localhost or the machine's own name.

    Another name could be that of a foreign page which its owner has pointed to this machine (DNS rebinding), so that
    the browser lets the page read the recording.
    """
    try:
        name = (urlsplit(f"//{host}").hostname or "").rstrip(".").lower()
    except ValueError:
        return False
    try:
        ipaddress.ip_address(name)
    except ValueError:
        machine = socket.gethostname().lower()
        return name in ("localhost", machine, machine.partition(".")[0])
    return True


def _fetch(address: str) -> bytes:
    deadline = time.monotonic() + WEB_TIMEOUT_S
    while True:
        try:
            with urllib.request.urlopen(address, timeout=WEB_TIMEOUT_S) as answer:
                return answer.read()
        except (urllib.error.URLError, ConnectionError) as error:
            if time.monotonic() > deadline:
                raise OutputError(f"the web viewer does not start ({address}: {error})") from error
            time.sleep(0.05)


class LiveView:
    """A viewer in a window; without a display in the browser, at an address that is printed to stderr.

    It reads the recording's own file while it grows, through the server above. Writing never waits for it.

    Attributes:
        server: serves the recording; None before `open`.
    """

    def __init__(self) -> None:
        self._ended = threading.Event()
        self.server: WebViewer | None = None

    def open(self, recording: Path) -> None:
        """Starts the viewer. A window stays open after the run until the user closes it."""
        in_window = display_is_there()
        self.server = WebViewer({} if in_window else web_viewer_assets(), recording, ended=self._ended)
        threading.Thread(target=self.server.serve, daemon=True).start()
        if in_window:
            start_viewer("--bind", LOOPBACK, "--port", "auto", f"{self.server.address}{RECORDING}")
        else:
            say(f"live view: {self.server.address}", err=True)

    def close(self) -> None:
        """Sends the rest of the recording, and stops the server. A window stays open."""
        self._ended.set()
        if self.server is not None:
            self.server.close()
