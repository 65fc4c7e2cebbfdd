"""A web server on loopback that serves one file, well or badly: the first part of a path says how."""

import ssl
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path


class Files(BaseHTTPRequestHandler):
    """`content` is the file. `asked`: path and Range of every request. `stop` ends what stalls."""

    protocol_version = "HTTP/1.1"
    content = b""
    asked: list[tuple[str, str]]
    stop: threading.Event

    def do_GET(self) -> None:
        how = self.path.split("/")[1]
        self.asked.append((how, self.headers.get("Range", "")))
        getattr(self, how)()

    def log_message(self, *arguments: object) -> None:
        pass

    @property
    def first(self) -> int:
        """The first byte that is asked for."""
        return int(self.headers.get("Range", "bytes=0-").removeprefix("bytes=").partition("-")[0])

    def send(self, body: bytes, *, length: int | None = None, tag: str = '"v1"', ranges: bool = True) -> None:
        """The body, or the rest of it, under a length that may be a lie; None: the true one."""
        first = self.first if ranges and self.headers.get("If-Range") == tag else 0
        total = len(self.content) if length is None else length
        self.send_response(206 if first else 200)
        if first:
            self.send_header("Content-Range", f"bytes {first}-{total - 1}/{total}")
        self.send_header("Content-Length", str(total - first))
        self.send_header("ETag", tag)
        self.end_headers()
        self.wfile.write(body[first:])
        self.close_connection = True

    def whole(self) -> None:
        self.send(self.content)

    def cut(self) -> None:
        """A third more with each request."""
        self.send(self.content[: len(self.content) * len(self.asked) // 3])

    def cut_for_ever(self) -> None:
        self.send(self.content[: len(self.content) // 2])

    def changing(self) -> None:
        """The second request finds another version, from whose start it has to be sent."""
        first = len(self.asked) == 1
        self.send(b"x" * 1000 if first else self.content, tag='"v1"' if first else '"v2"')

    def part(self, first: int, body: bytes, tag: str = '"v1"') -> None:
        self.send_response(206)
        self.send_header("Content-Range", f"bytes {first}-{first + len(body) - 1}/{len(self.content)}")
        self.send_header("Content-Length", str(len(body)))
        self.send_header("ETag", tag)
        self.end_headers()
        self.wfile.write(body)
        self.close_connection = True

    def half_first(self) -> bool:
        """True for the first request, which gets one half of the file."""
        if self.first:
            return False
        self.send(self.content[: len(self.content) // 2])
        return True

    def one_byte_more(self) -> None:
        self.send(self.content[: len(self.asked)])

    def half_without_ranges(self) -> None:
        self.send(self.content[: len(self.content) // 2], ranges=False)

    def rest_in_parts(self) -> None:
        if not self.half_first():
            self.part(self.first, self.content[self.first :][: len(self.content) // 8])

    def rest_of_another_version(self) -> None:
        if not self.half_first():
            self.part(self.first, bytes(byte ^ 1 for byte in self.content[self.first :]), '"v2"')

    def rest_from_elsewhere(self) -> None:
        if not self.half_first():
            self.part(self.first - 7, self.content[self.first - 7 :])

    def part_without_a_range(self) -> None:
        self.part(0, self.content[: len(self.content) // 2])

    def no_rest(self) -> None:
        if len(self.asked) == 2:
            self.send_error(416)
        else:
            self.send(self.content[: len(self.content) // (2 if len(self.asked) == 1 else 1)])

    def long_tag(self) -> None:
        self.send(self.content[: len(self.content) * len(self.asked) // 2], tag=f'"{"x" * 60_000}"')

    def slow_for_ever(self) -> None:
        self.send(b"")
        while not self.stop.wait(0.02):
            self.wfile.write(b"x" * 100)

    def no_header_ends(self) -> None:
        while not self.stop.wait(0.02):
            self.wfile.write(b"H")

    def without_ranges(self) -> None:
        self.send(self.content[: len(self.content) * len(self.asked) // 2], ranges=False)

    def stalling(self) -> None:
        self.send(self.content[: len(self.content) // 2])
        self.wfile.flush()
        self.stop.wait(20)

    def too_long(self) -> None:
        self.send(self.content, length=len(self.content) + 1000)

    def too_short(self) -> None:
        self.send(self.content, length=len(self.content) - 1000)

    def endless(self) -> None:
        self.send_response(200)
        self.end_headers()
        self.wfile.write(self.content + b"x" * 1000)
        self.close_connection = True

    def absurd_length(self, digits: int = 5000) -> None:
        self.send_response(200)
        self.send_header("Content-Length", "9" * digits)
        self.end_headers()
        self.wfile.write(self.content)
        self.close_connection = True

    def length_of_16_digits(self) -> None:
        """And it stays open, as if more came."""
        self.absurd_length(16)
        self.wfile.flush()
        self.stop.wait(20)

    def other(self) -> None:
        self.send(bytes(byte ^ 1 for byte in self.content))

    def busy_once(self) -> None:
        if len(self.asked) == 1:
            self.send_error(503)
        else:
            self.whole()

    def no_content(self) -> None:
        self.send_response(204)
        self.end_headers()

    def missing(self) -> None:
        self.send_error(404)

    def redirect(self) -> None:
        self._to(self.path.replace("/redirect/", "/whole/"))

    def redirect_to_http(self) -> None:
        self._to("http://127.0.0.1:1/weights.safetensors")

    def redirect_for_ever(self) -> None:
        self._to(self.path)

    def redirect_to_a_file(self) -> None:
        self._to("file:///etc/hostname")

    def _to(self, where: str) -> None:
        self.send_response(302)
        self.send_header("Location", where)
        self.send_header("Content-Length", "0")
        self.end_headers()


@contextmanager
def serving(content: bytes, certificate: Path | None = None) -> Iterator[tuple[str, type[Files]]]:
    """A server of a file: its address, and its handler, which knows what was asked.

    certificate: of a server of https; a file with the key, too.
    """
    handler = type("Handler", (Files,), {"content": content, "asked": [], "stop": threading.Event()})
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    server.daemon_threads = True
    if certificate is not None:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.load_cert_chain(certificate)
        server.socket = context.wrap_socket(server.socket, server_side=True)
    thread = threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True)
    thread.start()
    try:
        yield f"http{'s' if certificate else ''}://127.0.0.1:{server.server_port}", handler
    finally:
        handler.stop.set()
        server.shutdown()
        server.server_close()
        thread.join(5)
