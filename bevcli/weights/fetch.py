"""`fetch_weights`: weights by name, downloaded over HTTP with libcurl and checked.

A download that was cut goes on if the server still has the same file. libcurl keeps limits that the HTTP packages of
Python lack: on the speed, and on the time of all, name look-up and headers included. Each answer is checked before its
first byte is written.
"""

import contextlib
import hashlib
import os
import re
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any, BinaryIO

import msgspec

from bevcli.checkpoints import expected_state, read_checkpoint, require_fit
from bevcli.config import load_config
from bevcli.errors import BevcliError, OutputError, WeightsError
from bevcli.parsing.files import read_bytes
from bevcli.printing import counted
from bevcli.published import HASHES, Known, NamedWeights
from bevcli.weights import DownloadReport
from bevcli.writing import lock, output_errors

PARTIAL = ".partial-"  # before the name of a file that is being downloaded
STALL_S, STALL_BYTES = 20, 4096  # a transfer that is slower than so many bytes in a second, for so long, is cut
CONNECT_S = 20
WHOLE_S = 12 * 3600  # for all attempts
ATTEMPTS = 5  # that fail; one that brings a LEAST_SHARE-th of the file or more does not count
LEAST_SHARE = 16
PAUSE_S = 1.0  # after the first failed attempt; longer after the next ones
MOST_BYTES = 4 << 30  # of a file whose size is not in the table of sources
SPARE_BYTES = 64 << 20  # that stay free on the disk
MOST_REDIRECTS = 10
LONGEST_TAG = 256
NOT_RESUMED = (400, 412, 416, 431)  # statuses of a server that does not go on, but may send all
CONTENT_RANGE = re.compile(r"bytes (\d{1,15})-(\d{1,15})/(\d{1,15})")


@dataclass(frozen=True)
class FetchedWeights:
    """A file of weights that was checked.

    Attributes:
        path: the file.
        known: its hash and size.
        checked: how much of its hash was known before: "all", "the first N digits", "as at its first download", or
            "nothing", where only size, keys and shapes were.
    """

    path: Path
    known: Known
    checked: str


def fetch_weights(
    weights: NamedWeights, report: DownloadReport = lambda done, total, what: None, *, force: bool = False
) -> FetchedWeights:
    """The file of weights, downloaded if it is not there, and checked.

    The whole hash is checked if it is known. Else size, keys and shapes are; the hash is stored, and every later
    download must have it. A file that is refused is deleted. A source that is a path is checked where it lies.

    Args:
        weights: of `named_weights`.
        report: called with the bytes that are there, the size of the file or None, and name and URL.
        force: download a file that is there once more.

    Raises:
        WeightsError: there is no source, the download fails, or the file is not the expected one.
        OutputError: it cannot be written.
    """
    if weights.file is None:
        raise WeightsError(f"{weights.name}: {weights.by_hand}")
    if weights.source.path is not None or (not force and weights.here is not None):
        return _check(weights, weights.file)
    partial = weights.file.with_name(PARTIAL + weights.file.name)
    with output_errors(weights.file.parent):
        weights.file.parent.mkdir(parents=True, exist_ok=True)
    _require_space(partial.parent, (weights.source.bytes or 0) - (partial.stat().st_size if partial.exists() else 0))
    with output_errors(partial), partial.open("ab") as file:
        if not lock(file.fileno()):
            raise WeightsError(f"{partial}: another process is downloading it: wait for it, then try again")
        _Download(weights, file, report).run()
    try:
        fetched = _check(weights, partial)
    except BevcliError as error:
        _remove(partial)
        reason = str(error).replace(f"{partial}: ", "the file ", 1).replace(str(partial), "the file")
        raise WeightsError(f"{weights.source.url}: refused, and deleted: {reason}") from None
    weights.store_hash(fetched.known)
    os.replace(partial, weights.file)
    _remove(partial)
    return replace(fetched, path=weights.file)


def _check(weights: NamedWeights, path: Path) -> FetchedWeights:
    """The facts of a file that is the expected one. Raises WeightsError for another one."""
    if not path.is_file():
        raise WeightsError(f"{path}: weights file not found (the `source` of [{weights.name}])")
    with path.open("rb") as file:
        known = Known(hashlib.file_digest(file, "sha256").hexdigest(), path.stat().st_size)
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
    """A version of the file at a URL: its strong ETag, and its size in bytes."""

    url: str
    tag: str
    total: int


class _Failed(Exception):
    """Another attempt may help."""


def _require_space(folder: Path, wanted: int) -> None:
    """Raise OutputError where a disk has too little space. wanted: bytes."""
    free = shutil.disk_usage(folder).free - SPARE_BYTES
    if wanted > free:
        raise OutputError(
            f"{folder}: the disk has too little space: {wanted / 1e6:.0f} MB are needed, {max(free, 0) / 1e6:.0f} MB "
            "are free: free some, or pass `weights_dir` (`--weights-dir DIR`) on another disk"
        )


class _Download:
    """A download of several attempts. From https, redirects lead to https only.

    The file keeps what has come, also after an error, and a file beside it states its version: the next download goes
    on from there if the server says that the file is still the same.
    """

    def __init__(self, weights: NamedWeights, file: BinaryIO, report: DownloadReport) -> None:
        self.file, self.report, self.name = file, report, weights.name
        self.url, self.expected_bytes = weights.source.url, weights.source.bytes
        self.done = file.seek(0, os.SEEK_END)  # bytes that have come
        self.total: int | None = None  # of the file, as the server states it
        self._notes = Path(f"{file.name}.json")
        self._raised: BaseException | None = None

    def run(self) -> None:
        """Try until the file is whole, time is up, or several attempts have failed."""
        end, failed, highest = time.monotonic() + WHOLE_S, 0, self.done
        for attempts in count(1):
            try:
                self._attempt(end - time.monotonic())
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

    def _attempt(self, seconds: float) -> None:
        """Get what is missing. Raises _Failed, and WeightsError where no other attempt can help."""
        import pycurl

        self._part, self._accepted = self._usable_part(), False
        if self._part is None:
            self._start_anew()
        elif self._part.total == self.done:
            return
        curl = self._curl(pycurl, seconds)
        try:
            curl.perform()
        except pycurl.error as error:
            self._fail(pycurl, error, curl.getinfo(pycurl.RESPONSE_CODE))
        finally:
            curl.close()
            self.file.flush()
        if not self._accepted:  # a file without a byte
            self._accept()
        if self.total not in (None, self.done):
            raise _Failed(f"{self.done:,} of {self.total:,} bytes came")

    def _curl(self, pycurl: Any, seconds: float) -> Any:
        import certifi

        curl = pycurl.Curl()
        web = pycurl.PROTO_HTTP | pycurl.PROTO_HTTPS
        curl.setopt(pycurl.URL, self.url)
        curl.setopt(pycurl.PROTOCOLS, web)
        curl.setopt(pycurl.REDIR_PROTOCOLS, pycurl.PROTO_HTTPS if self.url.startswith("https:") else web)
        curl.setopt(pycurl.FOLLOWLOCATION, True)
        curl.setopt(pycurl.MAXREDIRS, MOST_REDIRECTS)
        curl.setopt(pycurl.FAILONERROR, True)
        curl.setopt(pycurl.NOSIGNAL, True)
        curl.setopt(pycurl.CONNECTTIMEOUT, CONNECT_S)
        curl.setopt(pycurl.TIMEOUT_MS, max(1, int(1000 * seconds)))
        curl.setopt(pycurl.LOW_SPEED_LIMIT, STALL_BYTES)
        curl.setopt(pycurl.LOW_SPEED_TIME, STALL_S)
        curl.setopt(pycurl.CAINFO, os.environ.get("SSL_CERT_FILE") or certifi.where())
        curl.setopt(pycurl.USERAGENT, "bevcli")
        curl.setopt(pycurl.HEADERFUNCTION, self._guarded(self._read_header))
        curl.setopt(pycurl.WRITEFUNCTION, self._guarded(self._write))
        if self._part is not None:
            curl.setopt(pycurl.RANGE, f"{self.done}-")
            curl.setopt(pycurl.HTTPHEADER, [f"If-Range: {self._part.tag}"])
        return curl

    def _guarded(self, callback: Callable[[bytes], None]) -> Callable[[bytes], int | None]:
        """The callback for libcurl: an exception, such as Ctrl-C, ends the transfer and is raised by `_fail`."""

        def called(data: bytes) -> int | None:
            try:
                callback(data)
            except BaseException as error:
                self._raised = error
                return -1
            return None

        return called

    def _read_header(self, line: bytes) -> None:
        text = line.decode("latin-1").strip()
        if text.startswith("HTTP/"):  # of each answer, redirects included
            self._headers = {":status": text.split()[1] if " " in text else ""}
        else:
            name, _, value = text.partition(":")
            self._headers[name.strip().lower()] = value.strip()

    def _accept(self) -> None:
        """Check the last answer before its first byte; the headers before were those of redirects, and of a proxy.

        A part must go on from what is there, in the same version. Raises _Failed and WeightsError.
        """
        part, length, tag = self._part, self._headers.get("content-length", ""), self._headers.get("etag", "")
        self._accepted, status = True, self._headers[":status"]
        if status == "206":
            stated = CONTENT_RANGE.fullmatch(self._headers.get("content-range", ""))
            first, last, self.total = map(int, stated.groups()) if stated else (-1, -1, -1)
            goes_on = part is not None and (first, self.total, tag or part.tag) == (self.done, part.total, part.tag)
            if not goes_on or not first <= last < self.total:
                self._start_anew()
                raise _Failed("the server sends a part that does not go on from what is there")
            self._most = last + 1
        elif status == "200":
            self._start_anew()
            self._most = self.expected_bytes or MOST_BYTES
            self.total = int(length) if length.isdecimal() and len(length) < 16 else None
            self._limit(self.total or 0)
            _require_space(self._notes.parent, self.total or 0)
            if self.total and tag.isprintable() and tag.startswith('"') and len(tag) <= LONGEST_TAG:  # W/…: a weak one
                self._notes.write_bytes(msgspec.json.encode(_Version(self.url, tag, self.total)))
        else:
            raise self._refused(status)
        self.report(self.done, self.total, f"{self.name}: {self.url}")

    def _write(self, data: bytes) -> None:
        if not self._accepted:
            self._accept()
        self._limit(self.done + len(data))
        if self.total is None:
            _require_space(self._notes.parent, len(data))
        self.file.write(data)
        self.done += len(data)
        self.report(self.done, self.total, f"{self.name}: {self.url}")

    def _limit(self, size: int) -> None:
        if size > self._most:
            self._start_anew()
            raise WeightsError(
                f"{self.url}: the server sends more than {self._most:,} bytes: refused (a larger file needs its size, "
                "as `bytes` in the table of sources)"
            )

    def _refused(self, status: object) -> WeightsError:
        return WeightsError(f"{self.url}: the server answers with status {status} (expected the file)")

    def _usable_part(self) -> _Version | None:
        """The version of the part that is there; None if it cannot be used."""
        try:
            version = msgspec.json.decode(read_bytes(self._notes, 1 << 16), type=_Version) if self.done else None
        except (msgspec.MsgspecError, ValueError, RecursionError, OSError, BevcliError):
            return None
        return version if version is not None and version.url == self.url and version.total >= self.done else None

    def _start_anew(self) -> None:
        self.file.truncate(0)
        self.done = 0
        self._notes.unlink(missing_ok=True)

    def _fail(self, pycurl: Any, error: Exception, status: int) -> None:
        """Raise what a callback has raised; _Failed if another attempt may help; else WeightsError."""
        if self._raised is not None:
            raise self._raised from None
        code, message = error.args
        if code == pycurl.E_HTTP_RETURNED_ERROR:
            if self._part is not None and status in NOT_RESUMED:
                self._start_anew()
            elif status not in (408, 429) and status < 500:
                raise self._refused(status)
            raise _Failed(f"status {status}")
        final = (pycurl.E_UNSUPPORTED_PROTOCOL, pycurl.E_URL_MALFORMAT, pycurl.E_TOO_MANY_REDIRECTS,
                 pycurl.E_PEER_FAILED_VERIFICATION, pycurl.E_SSL_CACERT_BADFILE)  # fmt: skip
        if code in final:
            raise WeightsError(f"{self.url}: cannot be downloaded ({message})")
        raise _Failed(message)
