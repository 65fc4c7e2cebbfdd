"""A web server on loopback that answers as the Hugging Face Hub does: commits, ETags, files behind a redirect."""

import hashlib
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


class Hub(BaseHTTPRequestHandler):
    """`commits`: commit -> file -> content, of the repository team/model, whose branch main is the last commit.

    `lies`: headers that take the place of the true ones. `pause_s`: before each byte of a body; negative: headers
    trickle.
    """

    protocol_version = "HTTP/1.1"
    commits: dict[str, dict[str, bytes]]
    asked: list[str]
    lies: dict[str, str]
    pause_s = 0.0
    status = 200

    def do_HEAD(self) -> None:
        self.answer(with_body=False)

    def do_GET(self) -> None:
        self.answer(with_body=True)

    def log_message(self, *arguments: object) -> None:
        pass

    def answer(self, *, with_body: bool) -> None:
        self.asked.append(f"{self.command} {self.path}")
        while self.pause_s < 0:
            self.wfile.write(b"H")
            time.sleep(0.05)
        parts = self.path.strip("/").split("/")
        if parts[0] == "api":
            self.send(b"{}", with_body=with_body)
            return
        if parts[0] == "cdn":  # another host, as the client sees it
            blobs = {digest(content): content for files in self.commits.values() for content in files.values()}
            self.send(blobs[parts[1]], with_body=with_body)
            return
        revision = list(self.commits)[-1] if parts[3] == "main" else parts[3]
        if parts[:3] != ["team", "model", "resolve"]:
            self.refuse("RepoNotFound", 401)
        elif revision not in self.commits:
            self.refuse("RevisionNotFound")
        elif parts[4] not in self.commits[revision]:
            self.refuse("EntryNotFound", **{"X-Repo-Commit": revision})
        elif parts[4].endswith(".safetensors"):  # a large file lies elsewhere
            content = self.commits[revision][parts[4]]
            headers = {"X-Linked-Etag": f'"{digest(content)}"', "X-Linked-Size": str(len(content))}
            location = f"http://localhost:{self.server.server_address[1]}/cdn/{digest(content)}"
            self.send(b"", 302, with_body=with_body, **headers, Location=location, **{"X-Repo-Commit": revision})
        else:
            self.send(self.commits[revision][parts[4]], with_body=with_body, **{"X-Repo-Commit": revision})

    def send(self, content: bytes, status: int = 200, *, with_body: bool, **headers: str) -> None:
        self.send_response(self.status if status == 200 else status)
        true = {"Content-Length": str(len(content)), "ETag": f'"{digest(content)}"'}
        for name, value in (true | headers | self.lies).items():
            self.send_header(name, value)
        self.end_headers()
        if with_body and self.pause_s:
            for byte in content:
                self.wfile.write(bytes([byte]))
                time.sleep(self.pause_s)
        elif with_body:
            self.wfile.write(content)

    def refuse(self, code: str, status: int = 404, **headers: str) -> None:
        self.send(b"", status, with_body=False, **{"X-Error-Code": code}, **headers)


def digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


@contextmanager
def serving() -> Iterator[tuple[str, type[Hub]]]:
    """A server: its address, and its handler, which has the commits and knows what was asked."""
    handler = type("Handler", (Hub,), {"commits": {}, "asked": [], "lies": {}})
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}", handler
    finally:
        server.shutdown()
        server.server_close()
        thread.join(5)
