"""LiveView: a viewer that follows a recording while it is written.

The recording goes into its file and, independently, to a stream on this machine's loopback address. Writing never waits
for the viewer: a viewer that is closed, killed or hangs does not slow the run down.
"""

from __future__ import annotations

import sys
import threading

import rerun as rr

from bevcli.viewer.native import LOOPBACK, display_is_there, free_port, start_viewer
from bevcli.viewer.web import WebViewer, web_viewer_assets

KEPT_FOR_LATE_VIEWERS = "256MB"  # of memory; beyond it the stream drops its oldest frames (the file keeps all)


class LiveView:
    """A viewer in a window; without a display in the browser, at an address that is printed to stderr."""

    def __init__(self) -> None:
        port = free_port(9876)
        self.sink = rr.GrpcServerSink(LOOPBACK, port, server_memory_limit=KEPT_FOR_LATE_VIEWERS)
        self.stream_address = f"rerun+http://{LOOPBACK}:{port}/proxy"
        self._web: WebViewer | None = None

    def open(self) -> None:
        """Starts the viewer. A window stays open after the run until the user closes it."""
        if display_is_there():
            start_viewer("--bind", LOOPBACK, "--port", "auto", "--connect", self.stream_address)
            return
        self._web = WebViewer(web_viewer_assets(), self.stream_address)
        threading.Thread(target=self._web.serve, daemon=True).start()
        print(f"live view: {self._web.address}", file=sys.stderr)

    def close(self) -> None:
        """Stops the web viewer's server. A window stays open."""
        if self._web is not None:
            self._web.close()
