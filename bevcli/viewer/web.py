"""Serves the web viewer and a recording from one address.

Rerun's own web server listens on all network interfaces and keeps a core busy. This server takes the files of the web
viewer from the installed viewer once, and serves them and the recording from one origin. A content security policy
lets the pages connect to that origin only; so the viewer in the browser cannot send telemetry.
"""

from __future__ import annotations

import ipaddress
import re
import shutil
import socket
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, quote, urlsplit

from bevcli.errors import OutputError
from bevcli.viewer.native import LOOPBACK, free_port, start_viewer, stop

ASSETS = {
    "/": "text/html; charset=utf-8",
    "/re_viewer.js": "text/javascript",
    "/re_viewer_bg.wasm": "application/wasm",
    "/favicon.ico": "image/x-icon",
}
RECORDING = "/recording.rrd"
START_TIMEOUT_S = 15.0
STOP_TIMEOUT_S = 5.0
CONNECTION_TIMEOUT_S = 60.0
MOST_CONNECTIONS = 64
FONT_LINKS = re.compile(rb"<link[^>]*https://fonts[^>]*>", re.DOTALL)  # links to Google's fonts; removed


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


class WebViewer:
    """A web server for the viewer and a recording.

    Args:
        assets: the web viewer's files by path (`web_viewer_assets`).
        source: the file of a recording, or the address of a live stream (rerun+http://…).
        host: the address to listen on.
        port: the preferred port; if it is in use, the next free one is taken.
    """

    def __init__(
        self, assets: dict[str, bytes], source: Path | str, host: str = LOOPBACK, port: int | None = 9090
    ) -> None:
        self.host, self.port = host, free_port(port, host)
        handler = partial(_Handler, assets, source)
        self._server = _Server((host, self.port), handler)

    @property
    def address(self) -> str:
        """The address to open in a browser."""
        return f"http://{self.host}:{self.port}"

    def serve(self) -> None:
        """Serves until `close` is called from another thread."""
        self._server.serve_forever(poll_interval=1.0)

    def close(self) -> None:
        """Stops `serve`, and frees the port."""
        # shutdown waits until `serve` has ended, without a limit.
        stopping = threading.Thread(target=self._server.shutdown, daemon=True)
        stopping.start()
        stopping.join(STOP_TIMEOUT_S)
        self._server.server_close()


class _Server(ThreadingHTTPServer):
    """A thread for each connection, MOST_CONNECTIONS at a time. A connection that breaks is no error."""

    daemon_threads = True

    def __init__(self, address: tuple[str, int], handler: Callable[..., BaseHTTPRequestHandler]) -> None:
        if ":" in address[0]:
            self.address_family = socket.AF_INET6
        self._free = threading.BoundedSemaphore(MOST_CONNECTIONS)
        super().__init__(address, handler)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Starts the thread of a connection; closes the connection if there are too many."""
        if not self._free.acquire(blocking=False):
            self.shutdown_request(request)
            return
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Runs in the thread of a connection."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Prints nothing if the browser has gone or is silent."""
        if not isinstance(sys.exception(), (ConnectionError, TimeoutError)):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    timeout = CONNECTION_TIMEOUT_S  # of each read and write

    def __init__(self, assets: dict[str, bytes], source: Path | str, *request: object) -> None:
        self.assets, self.source = assets, source
        super().__init__(*request)  # type: ignore[arg-type]

    def do_GET(self) -> None:
        """Serves the viewer's files and the recording; "/" redirects to the viewer with the recording."""
        parts = urlsplit(self.path)
        if not _is_own_name(self.headers.get("Host", "")):
            self._send_head(403, "text/plain", 0)
        elif parts.path == RECORDING and isinstance(self.source, Path):
            self._send_recording(self.source)
        elif parts.path == "/" and "url" not in parse_qs(parts.query):
            self._redirect(parts.query)
        elif parts.path in self.assets:
            self._send_head(200, ASSETS[parts.path], len(self.assets[parts.path]))
            self.wfile.write(self.assets[parts.path])
        else:
            self._send_head(404, "text/plain", 0)

    def log_message(self, format: str, *arguments: object) -> None:
        """Logs nothing, so that the terminal stays readable."""

    def _redirect(self, query: str) -> None:
        host = self.headers.get("Host", "")
        url = self.source if isinstance(self.source, str) else f"http://{host}{RECORDING}"
        self.send_response(302)
        # The labels of images and of the scene are unreadable in the light theme of a light browser.
        theme = "" if "theme" in parse_qs(query) else "&theme=dark"
        self.send_header("Location", f"/?url={quote(url, safe='')}{theme}" + (f"&{query}" if query else ""))
        self.send_header("Content-Length", "0")
        self.end_headers()

    def _send_recording(self, path: Path) -> None:
        with path.open("rb") as file:
            self._send_head(200, "application/octet-stream", path.stat().st_size)
            shutil.copyfileobj(file, self.wfile, 1 << 20)

    def _send_head(self, status: int, media_type: str, length: int) -> None:
        live = "" if isinstance(self.source, Path) else self.source.removeprefix("rerun+").removesuffix("/proxy")
        self.send_response(status)
        self.send_header("Content-Type", media_type)
        self.send_header("Content-Length", str(length))
        self.send_header("Content-Security-Policy", f"connect-src 'self' blob: data: {live}".strip())
        self.end_headers()


def _is_own_name(host: str) -> bool:
    """Whether a Host header names this machine: an IP address, localhost or the machine's own name.

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
        own = socket.gethostname().lower()
        return name in ("localhost", own, own.partition(".")[0])
    return True


def _fetch(address: str) -> bytes:
    deadline = time.monotonic() + START_TIMEOUT_S
    while True:
        try:
            with urllib.request.urlopen(address, timeout=START_TIMEOUT_S) as answer:
                return answer.read()
        except (urllib.error.URLError, ConnectionError) as error:
            if time.monotonic() > deadline:
                raise OutputError(f"the web viewer does not start ({address}: {error})") from error
            time.sleep(0.05)
