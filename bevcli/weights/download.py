"""`download`: a file by HTTP with libcurl, which resumes a cut download.

pooch starts a cut download anew. huggingface_hub resumes one, but by an internal function that neither asks whether the
file is still the same nor ends a download that trickles. libcurl does both.
"""

import os
import shutil
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import msgspec

from bevcli.errors import OutputError, WeightsError
from bevcli.parsing.files import read_bytes
from bevcli.writing import output_errors

STALL_S, STALL_BYTES = 30, 1024  # a transfer that is slower than so many bytes in a second, for so long, is cut
CONNECT_S = 20
ATTEMPTS = 4  # in a row without a new byte
PAUSE_S = 2.0  # before the second attempt; longer before the next ones
MOST_BYTES = 20 << 30  # of a file whose size is not known
SPARE_BYTES = 64 << 20  # that stay free on the disk
MOST_REDIRECTS = 10
Report = Callable[[int, int | None], None]


class _Validator(msgspec.Struct, frozen=True):
    """What tells one version of a file at a URL from another, for If-Range. total: its size in bytes."""

    url: str
    tag: str
    total: int | None


def download(url: str, path: Path, expected_bytes: int | None, report: Report) -> None:
    """Download a file. What an earlier call left is kept, if the server says that the file is still the same.

    Args:
        url: http:// or https://. From https, redirects lead to https only.
        path: where to write. After an error it holds the part that has come, and PATH.json what tells its version.
        expected_bytes: size of the file, if it is known: another size at the server ends the download at once.
        report: called with the bytes that are there, and with the size of the file or None.

    Raises:
        WeightsError: the server cannot be reached, refuses, has a file of another size, or broke off too often.
        OutputError: the disk has too little space, or the file cannot be written.
    """
    require_space(path.parent, (expected_bytes or 0) - (path.stat().st_size if path.exists() else 0))
    with output_errors(path), path.open("ab") as file:
        _lock(file, path)
        _download(_Transfer(url, path, file, expected_bytes, report))


def require_space(folder: Path, wanted: int) -> None:
    """Raise OutputError where a disk has too little space. wanted: bytes."""
    free = shutil.disk_usage(folder).free - SPARE_BYTES
    if wanted > free:
        raise OutputError(
            f"{folder}: the disk has too little space: {wanted / 1e6:.0f} MB are needed, {max(free, 0) / 1e6:.0f} MB "
            "are free: free some, or pass `weights_dir=DIR` on another disk"
        )


def _lock(file: BinaryIO, path: Path) -> None:
    """Raises WeightsError while another process downloads the same file."""
    if sys.platform == "win32":
        return
    import fcntl

    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise WeightsError(f"{path}: another process is downloading it: wait for it, then try again") from None


def _download(transfer: "_Transfer") -> None:
    """Try until the file is whole, or until several attempts in a row have brought nothing."""
    failed, problem = 0, ""
    while failed < ATTEMPTS:
        if failed:
            time.sleep(PAUSE_S * failed)
        before = transfer.done
        problem = transfer.attempt()
        if not problem:
            return
        failed = 0 if transfer.done > before else failed + 1
    raise WeightsError(
        f"{transfer.url}: the download broke off {ATTEMPTS} times in a row ({problem}); {transfer.done:,} bytes "
        "are kept: the same command goes on from there"
    )


@dataclass
class _Transfer:
    """A download of several attempts. total: size of the file as the server states it."""

    url: str
    path: Path
    file: BinaryIO
    expected_bytes: int | None
    report: Report
    total: int | None = None
    _headers: dict[str, str] = field(default_factory=dict)
    _raised: BaseException | None = None

    @property
    def done(self) -> int:
        """Bytes that have come."""
        return self.file.seek(0, os.SEEK_END)

    @property
    def _notes(self) -> Path:
        return self.path.with_name(f"{self.path.name}.json")

    def attempt(self) -> str:
        """Get what is missing. Returns why the transfer broke off, "" if the file is whole."""
        import pycurl

        validator = self._validator()
        if validator is None:
            self._start_anew()
        elif validator.total == self.done:
            return ""
        curl = self._curl(pycurl, validator)
        try:
            curl.perform()
            status = curl.getinfo(pycurl.RESPONSE_CODE)
        except pycurl.error as error:
            if self._raised is not None:
                raise self._raised from None
            code, message = error.args
            return self._failure(pycurl, code, message, curl.getinfo(pycurl.RESPONSE_CODE))
        finally:
            curl.close()
            self.file.flush()
        if status not in (200, 206):
            raise WeightsError(f"{self.url}: the server answers with status {status} (expected the file)")
        if self.total is not None and self.done != self.total:
            return f"{self.done:,} of {self.total:,} bytes came"
        return ""

    def _curl(self, pycurl: Any, validator: _Validator | None) -> Any:
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
        curl.setopt(pycurl.LOW_SPEED_LIMIT, STALL_BYTES)
        curl.setopt(pycurl.LOW_SPEED_TIME, STALL_S)
        curl.setopt(pycurl.CAINFO, os.environ.get("SSL_CERT_FILE") or certifi.where())
        curl.setopt(pycurl.USERAGENT, "bevcli")
        curl.setopt(pycurl.HEADERFUNCTION, self._guarded(self._read_header))
        curl.setopt(pycurl.WRITEFUNCTION, self._guarded(self._write))
        if validator is not None:
            curl.setopt(pycurl.RESUME_FROM_LARGE, self.done)
            curl.setopt(pycurl.HTTPHEADER, [f"If-Range: {validator.tag}"])
        return curl

    def _guarded(self, callback: Callable[[bytes], None]) -> Callable[[bytes], int | None]:
        """The callback for libcurl: an exception, such as Ctrl-C, ends the transfer and is raised by `attempt`."""

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
            self._headers = {"status": text.split()[1] if " " in text else ""}
        elif text:
            name, _, value = text.partition(":")
            self._headers[name.strip().lower()] = value.strip()
        elif self._headers.get("status") in ("200", "206"):
            self._begin()

    def _begin(self) -> None:
        """Check what the server states of the file, before its first byte."""
        length, status = self._headers.get("content-length", ""), self._headers["status"]
        self.total = (
            int(length) + (self.done if status == "206" else 0) if length.isdecimal() and len(length) < 16 else None
        )
        if self.expected_bytes and self.total not in (None, self.expected_bytes):
            raise WeightsError(
                f"{self.url}: the server states {self.total:,} bytes, expected {self.expected_bytes:,}: it is another "
                "file, or the source is wrong"
            )
        if self.total is not None:
            require_space(self.path.parent, self.total - self.done)
        tag = self._headers.get("etag", "")
        if status == "200" and tag and not tag.startswith("W/"):  # a weak one does not promise the same bytes
            self._notes.write_bytes(msgspec.json.encode(_Validator(self.url, tag, self.total)))
        self.report(self.done, self.total)

    def _write(self, data: bytes) -> None:
        if self.done + len(data) > (self.expected_bytes or self.total or MOST_BYTES):
            raise WeightsError(f"{self.url}: the server sends more than the {self.done:,} bytes of the file: refused")
        self.file.write(data)
        self.report(self.done, self.total)

    def _validator(self) -> _Validator | None:
        """What tells the version of the part that is there; None if it is of no use."""
        if not self.done or not self._notes.is_file():
            return None
        try:
            found = msgspec.json.decode(read_bytes(self._notes, 1 << 16), type=_Validator)
        except (msgspec.MsgspecError, ValueError, RecursionError):
            return None
        usable = found.url == self.url and found.tag.isprintable() and (found.total or MOST_BYTES) >= self.done
        return found if usable else None

    def _start_anew(self) -> None:
        self.file.truncate(0)
        self._notes.unlink(missing_ok=True)

    def _failure(self, pycurl: Any, code: int, message: str, status: int) -> str:
        """Why a transfer broke off, if another attempt may help. Raises WeightsError if not."""
        if code == pycurl.E_RANGE_ERROR or status == 416:  # the file has changed, or the server cannot resume
            self._start_anew()
            return "the server does not resume"
        if code == pycurl.E_HTTP_RETURNED_ERROR and (status in (408, 429) or status >= 500):
            return f"status {status}"
        if code == pycurl.E_HTTP_RETURNED_ERROR:
            raise WeightsError(f"{self.url}: the server answers with status {status} (expected the file)")
        final = (pycurl.E_UNSUPPORTED_PROTOCOL, pycurl.E_URL_MALFORMAT, pycurl.E_TOO_MANY_REDIRECTS,
                 pycurl.E_PEER_FAILED_VERIFICATION, pycurl.E_SSL_CACERT_BADFILE)  # fmt: skip
        if code in final:
            raise WeightsError(f"{self.url}: cannot be downloaded ({message})")
        return message
