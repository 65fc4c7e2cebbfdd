"""Cases of servers of weights that break off, lie, change their file and answer other questions than were asked."""

import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from random import Random

from bevcli.workshop.weights import fetch

MOST_REQUESTS = fetch.ATTEMPTS + fetch.LEAST_SHARE + 1


def server_behaviour(seeds: Path, case: Path, random: Random) -> None:
    """A file that arrives is one of the server's versions, byte by byte; or the download ends after some requests."""
    versions = {f'"{name}"': random.randbytes(random.randrange(1, 100_000)) for name in "ab"}
    asked: list[str] = []
    handler = type("Handler", (Answers,), {"random": random, "versions": versions, "asked": asked})
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
    fetch.PAUSE_S, fetch.STALL_S = 0.0, 1
    try:
        for _ in range(2):  # the second command goes on with what the first one has left
            asked.clear()
            try:
                url = f"http://127.0.0.1:{server.server_port}/w.pth"
                with (case / "w").open("ab") as file:
                    for _ in fetch.Download(url, file, None).run():
                        pass
            finally:
                assert len(asked) <= MOST_REQUESTS, f"{len(asked)} requests"
            assert (case / "w").read_bytes() in versions.values()
    finally:
        server.shutdown()
        server.server_close()


class Answers(BaseHTTPRequestHandler):
    """Each answer is a choice of `random`. Bytes under a tag are those of its version, at the stated place."""

    protocol_version = "HTTP/1.1"
    random: Random
    versions: dict[str, bytes]
    asked: list[str]

    def log_message(self, *arguments: object) -> None:
        pass

    def do_GET(self) -> None:
        choose = self.random
        self.asked.append(self.headers.get("Range", ""))
        self.close_connection = True
        if choose.random() < 0.15:
            self.send_error(choose.choice((204, 400, 404, 412, 416, 429, 500, 503)))
            return
        tag = choose.choice(['"a"'] * 5 + ['"b"'])
        content = self.versions[tag]
        first = int(self.asked[-1].removeprefix("bytes=").partition("-")[0] or 0)
        if not first or choose.random() < 0.2:
            self._answer(200, content, len(content) + choose.choice((0, 0, 0, 0, 7)), {"ETag": self._tag(tag)})
            return
        first = choose.choice((first, first, first, first, 0, max(0, first - 3), first + 3, len(content) - 1))
        last = choose.choice((len(content), len(content), first + len(content) // 8, first + 1))
        body = content[first:last]
        total = choose.choice((len(content), len(content), len(content), len(content) + 5, "*", "x", 10**20))
        stated = {"Content-Range": f"bytes {first}-{first + len(body) - 1}/{total}", "ETag": tag}
        if choose.random() < 0.1:
            del stated["Content-Range"]
        self._answer(206, body, len(body), stated)

    def _tag(self, tag: str) -> str:
        return self.random.choice((tag, tag, tag, f"W/{tag}", "", '"' + "x" * 50_000 + '"', "\xff\xfe"))

    def _answer(self, status: int, body: bytes, length: int, headers: dict[str, str]) -> None:
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name, value)
        is_cut = self.random.random() < 0.5
        if is_cut or self.random.random() < 0.8:  # the end of a file without a length cannot be told from a cut
            self.send_header("Content-Length", str(length))
        self.end_headers()
        self.wfile.write(body[: self.random.randrange(len(body) + 1)] if is_cut else body)
