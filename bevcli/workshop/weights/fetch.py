"""`fetch_weights`: weights by name, downloaded over HTTP and checked.

A download that was cut goes on if the server still has the same file. Each answer is checked before its first byte is
written.
"""

import contextlib
import os
import re
import shutil
import ssl
import threading
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import partial
from http.client import HTTPException, HTTPResponse, InvalidURL
from itertools import count
from pathlib import Path
from typing import IO, Any, BinaryIO, cast
from urllib.error import HTTPError, URLError
from urllib.request import HTTPRedirectHandler, HTTPSHandler, Request, build_opener

import msgspec

from bevcli.checkpoints import expected_state, read_checkpoint, require_fit
from bevcli.config import load_config
from bevcli.errors import BevcliError, OutputError, WeightsError
from bevcli.parsing.files import hash_of_file, read_bytes
from bevcli.printing import counted, reason_of
from bevcli.published import HASHES, Known, NamedWeights, read_hashes
from bevcli.writing import lock, output_errors, write_whole

PARTIAL = ".partial-"  # before the name of a file that is being downloaded
STALL_S, STALL_BYTES = 20, 4096  # a transfer that is slower than so many bytes in a second, for so long, is cut
HEADERS_S = 60  # for the headers of an answer, however they trickle
WHOLE_S = 12 * 3600  # for all attempts
ATTEMPTS = 5  # that fail; one that brings a LEAST_SHARE-th of the file or more does not count
LEAST_SHARE = 16
PAUSE_S = 1.0  # after the first failed attempt; longer after the next ones
MOST_BYTES = 4 << 30  # of a file whose size is not in the table of sources
SPARE_BYTES = 64 << 20  # that stay free on the disk
BLOCK = 1 << 20  # bytes
LENGTH_DIGITS = 16  # of a file's length that are read
LONGEST_TAG = 256
NOT_RESUMED = (400, 412, 416, 431)  # statuses of a server that does not go on, but may send all
CONTENT_RANGE = re.compile(r"bytes (\d{1,15})-(\d{1,15})/(\d{1,15})")


@dataclass(frozen=True)
class FetchedWeights:
    """A file of weights that was checked."""

    path: Path  # the file
    known: Known  # its hash and size
    # how much of its hash was known before: "all", "the first N digits", "as at its first download", or "nothing",
    # where only size, keys and shapes were
    checked: str


def fetch_weights(weights: NamedWeights, *, force: bool = False) -> FetchedWeights:
    """The file of weights, downloaded if it is not there, and checked.

    The whole hash is checked if it is known. Else size, keys and shapes are; the hash is stored, and every later
    download must have it. A file that is refused is deleted. A source that is a path is checked where it lies.

    Args:
        weights: of `named_weights`.
        force: download a file that is there once more.

    Raises:
        WeightsError: there is no source, the download fails, or the file is not the expected one.
        OutputError: it cannot be written.
    """
    for _ in download_weights(weights, force=force):
        pass
    assert weights.file is not None
    partial = _partial(weights.file)
    if not partial.exists():
        return _check(weights, weights.file)
    try:
        fetched = _check(weights, partial)
    except BevcliError as error:
        _remove(partial)
        reason = str(error).replace(f"{partial}: ", "the file ", 1).replace(str(partial), "the file")
        raise WeightsError(f"{weights.source.url}: refused, and deleted: {reason}") from None
    _store_hash(weights, fetched.known)
    os.replace(partial, weights.file)
    _remove(partial)
    return replace(fetched, path=weights.file)


def _store_hash(weights: NamedWeights, known: Known) -> None:
    """Store the hash of a file that was downloaded. Raises OutputError."""
    hashes = {**read_hashes(weights.folder), weights.source.source: known}
    content = msgspec.json.format(msgspec.json.encode(hashes), indent=1)
    write_whole(weights.folder / HASHES, content + b"\n", parents=True)


def download_weights(weights: NamedWeights, *, force: bool = False) -> Iterator[tuple[int, int | None]]:
    """Download what `fetch_weights` then checks: nothing for a file that is there.

    Yields the bytes that have come, and the size of the file or None. Raises WeightsError and OutputError.
    """
    if weights.file is None:
        raise WeightsError(f"{weights.name}: {weights.by_hand}")
    if weights.source.path is not None or (not force and weights.here is not None):
        return
    partial = _partial(weights.file)
    with output_errors(weights.file.parent):
        weights.file.parent.mkdir(parents=True, exist_ok=True)
    _require_space(partial.parent, (weights.source.bytes or 0) - (partial.stat().st_size if partial.exists() else 0))
    with output_errors(partial), partial.open("ab") as file:
        if not lock(file.fileno()):
            raise WeightsError(f"{partial}: another process is downloading it: wait for it, then try again")
        yield from Download(weights.source.url, file, weights.source.bytes).run()


def _partial(file: Path) -> Path:
    return file.with_name(PARTIAL + file.name)


def _check(weights: NamedWeights, path: Path) -> FetchedWeights:
    """The facts of a file that is the expected one. Raises WeightsError for another one."""
    if not path.is_file():
        raise WeightsError(f"{path}: weights file not found (the `source` of [{weights.name}])")
    known = Known(hash_of_file(path), path.stat().st_size)
    source, before = weights.source, weights.known
    if source.bytes not in (None, known.bytes):
        raise WeightsError(f"{path}: has {known.bytes:,} bytes (expected {source.bytes:,})")
    if not known.sha256.startswith(source.sha256):
        raise WeightsError(f"{path}: has the SHA-256 {known.sha256} (expected {source.sha256})")
    if before is not None and before != known:
        raise WeightsError(
            f"{path}: has the SHA-256 {known.sha256}, but the first download had {before.sha256}: the file at the "
            f"source has changed; if you trust it, remove its line from {weights.folder / HASHES}"
        )
    config = load_config(weights.name)
    require_fit(read_checkpoint(path), config.name, expected_state(config))
    digits = len(source.sha256)
    if digits == 64:
        return FetchedWeights(path, known, "all")
    if before is not None:
        return FetchedWeights(path, known, "as at its first download")
    return FetchedWeights(path, known, f"the first {digits} digits" if digits else "nothing")


def _remove(partial: Path) -> None:
    for path in (partial, partial.with_name(f"{partial.name}.json")):
        with contextlib.suppress(OSError):
            path.unlink()


class _Version(msgspec.Struct, frozen=True):
    """A version of the file at a URL: its strong ETag, "" for none, and its size in bytes."""

    url: str
    tag: str
    total: int


class _Failed(Exception):
    """Another attempt may help."""


def _require_space(folder: Path, needed: int) -> None:
    """Raise OutputError where a disk has too little space. wanted: bytes."""
    free = shutil.disk_usage(folder).free - SPARE_BYTES
    if needed > free:
        raise OutputError(
            f"{folder}: the disk has too little space: {needed / 1e6:.0f} MB are needed, {max(free, 0) / 1e6:.0f} MB "
            "are free: free some, or pass `weights_dir` (`--weights-dir DIR`) on another disk"
        )


class _Redirects(HTTPRedirectHandler):
    """Follows up to ten redirects, from https to https only."""

    max_repeats = 10

    def redirect_request(
        self, req: Request, fp: IO[bytes], code: int, msg: str, headers: Any, newurl: str
    ) -> Request | None:
        """The next request. Raises HTTPError."""
        if not newurl.startswith("https:" if req.type == "https" else ("http:", "https:")):
            raise HTTPError(newurl, code, f"a redirect to {newurl:.200} is not followed", headers, fp)
        return super().redirect_request(req, fp, code, msg, headers, newurl)


def steady(parts: Iterable[bytes]) -> Iterator[bytes]:
    """The parts of an answer as they come. Raises TimeoutError where they come too slowly."""
    began, came = time.monotonic(), 0
    for part in parts:
        yield part
        came += len(part)
        if (now := time.monotonic()) > began + STALL_S:
            if came < STALL_BYTES * STALL_S:
                raise TimeoutError(f"slower than {STALL_BYTES} bytes a second")
            began, came = now, 0


def answered(send: Any, *arguments: Any, **options: Any) -> Any:
    """The answer that `send` returns once its headers are there. Raises TimeoutError where they take too long."""
    answer: Future[Any] = Future()

    def wait() -> None:
        try:
            answer.set_result(send(*arguments, **options))
        except BaseException as error:
            answer.set_exception(error)

    threading.Thread(target=wait, daemon=True).start()  # which nothing else ends: a byte now and then is no timeout
    try:
        return answer.result(HEADERS_S)
    except TimeoutError as error:
        raise TimeoutError(str(error) or f"no answer within {HEADERS_S} s") from None


class Download:
    """A download of several attempts.

    The file keeps what has come, also after an error, and a file beside it states its version: the next download goes
    on from there if the server says that the file is still the same.

    Args:
        url: of http or https.
        file: open for appending, empty or with what came before.
        expected_bytes: None if they are not known.
    """

    def __init__(self, url: str, file: BinaryIO, expected_bytes: int | None) -> None:
        self.url, self.file, self.expected_bytes = url, file, expected_bytes
        self.done = file.seek(0, os.SEEK_END)  # bytes that have come
        self.total: int | None = None  # of the file, as the server states it
        self._notes = Path(f"{file.name}.json")
        self._most = 0  # bytes that are accepted

    def run(self) -> Iterator[tuple[int, int | None]]:
        """Try until the file is whole, time is up, or several attempts have failed; yields `done` and `total`."""
        end, failed, highest = time.monotonic() + WHOLE_S, 0, self.done
        for attempts in count(1):
            try:
                yield from self._attempt(end)
                self._note(_Version(self.url, "", self.done))
                return
            except _Failed as error:
                problem = error
            least = max(1, (self.total or MOST_BYTES) // LEAST_SHARE)
            failed += self.done - highest < least
            highest = max(highest, self.done)
            if failed >= ATTEMPTS or time.monotonic() + PAUSE_S * failed >= end:
                is_kept = self._usable_part() is not None
                kept = f"{self.done:,} bytes are kept: the same command goes on from there" if is_kept else "try later"
                raise WeightsError(
                    f"{self.url}: the download broke off {counted(attempts, 'times')} ({problem}); {kept}"
                )
            time.sleep(PAUSE_S * failed)

    def _attempt(self, end: float) -> Iterator[tuple[int, int | None]]:
        """Get what is missing. Raises _Failed, and WeightsError where no other attempt can help."""
        part = self._usable_part()
        if part is None:
            self._start_anew()
        elif part.total == self.done:
            return
        try:
            with self._open(part) as answer:
                self._accept(answer, part)
                yield self.done, self.total
                for data in steady(iter(partial(answer.read1, BLOCK), b"")):
                    self._write(data)
                    yield self.done, self.total
                    if time.monotonic() > end:
                        raise _Failed("timed out")
        except (OSError, HTTPException, ValueError) as error:  # a chunk of a damaged length is a ValueError
            raise _Failed(str(error) or type(error).__name__) from None
        finally:
            self.file.flush()
        if self.total not in (None, self.done):
            raise _Failed(f"{self.done:,} of {self.total:,} bytes came")

    def _open(self, part: _Version | None) -> HTTPResponse:
        """The server's answer. Raises _Failed and WeightsError."""
        headers = {"User-Agent": "bevcli"}
        if part is not None:
            headers |= {"Range": f"bytes={self.done}-", "If-Range": part.tag}
        try:
            opener = build_opener(_Redirects, HTTPSHandler(context=ssl.create_default_context()))
            return cast(HTTPResponse, answered(opener.open, Request(self.url, headers=headers), timeout=STALL_S))
        except HTTPError as error:
            error.close()
            if error.code < 400:
                raise WeightsError(f"{self.url}: cannot be downloaded ({reason_of(error)})") from None
            if part is not None and error.code in NOT_RESUMED:
                self._start_anew()
            elif error.code not in (408, 429) and error.code < 500:
                raise self._refused(error.code) from None
            raise _Failed(f"status {error.code}") from None
        except (URLError, InvalidURL) as error:
            reason = getattr(error, "reason", error)
            if isinstance(reason, ssl.SSLCertVerificationError | InvalidURL):
                raise WeightsError(f"{self.url}: cannot be downloaded ({reason})") from None
            raise _Failed(str(reason)) from None

    def _accept(self, answer: HTTPResponse, part: _Version | None) -> None:
        """Check an answer before its first byte. A part must go on from what is there, in the same version.

        Raises _Failed and WeightsError.
        """
        length, tag = answer.headers.get("Content-Length", ""), answer.headers.get("ETag", "")
        if answer.status == 206:
            match = CONTENT_RANGE.fullmatch(answer.headers.get("Content-Range", ""))
            first, last, self.total = map(int, match.groups()) if match else (-1, -1, -1)
            goes_on = part is not None and (first, self.total, tag or part.tag) == (self.done, part.total, part.tag)
            if not goes_on or not first <= last < self.total:
                self._start_anew()
                raise _Failed("the server sends a part that does not go on from what is there")
            self._most = last + 1
        elif answer.status == 200:
            self._start_anew()
            self._most = self.expected_bytes or MOST_BYTES
            self.total = int(length[:LENGTH_DIGITS]) if length.isdecimal() else None  # a longer one is too large anyway
            self._limit(self.total or 0)
            _require_space(self._notes.parent, self.total or 0)
            if self.total and tag.isprintable() and tag.startswith('"') and len(tag) <= LONGEST_TAG:  # W/…: a weak one
                self._note(_Version(self.url, tag, self.total))
        else:
            raise self._refused(answer.status)

    def _write(self, data: bytes) -> None:
        self._limit(self.done + len(data))
        if self.total is None:
            _require_space(self._notes.parent, len(data))
        self.file.write(data)
        self.done += len(data)

    def _limit(self, size: int) -> None:
        if size > self._most:
            self._start_anew()
            raise WeightsError(
                f"{self.url}: the server sends more than {self._most:,} bytes: refused (a larger file needs its size, "
                "as `bytes` in the table of sources)"
            )

    def _refused(self, status: int) -> WeightsError:
        return WeightsError(f"{self.url}: the server answers with status {status} (expected the file)")

    def _note(self, version: _Version) -> None:
        self._notes.write_bytes(msgspec.json.encode(version))

    def _usable_part(self) -> _Version | None:
        """The version of the part that is there; None if it cannot be used. Without a tag it must be whole."""
        try:
            version = msgspec.json.decode(read_bytes(self._notes, 1 << 16), type=_Version) if self.done else None
        except (msgspec.MsgspecError, ValueError, RecursionError, OSError, BevcliError):
            return None
        is_usable = version is not None and version.url == self.url and version.total >= self.done
        return version if version and is_usable and (version.tag or version.total == self.done) else None

    def _start_anew(self) -> None:
        self.file.truncate(0)
        self.done = 0
        self._notes.unlink(missing_ok=True)
