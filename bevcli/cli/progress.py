"""A progress bar on a terminal, plain lines on a pipe; both say what is done, how fast, and the time left."""

from __future__ import annotations

import sys
import time
from types import TracebackType
from typing import TextIO

LINES_ON_A_PIPE = 10  # about how many plain lines a whole run prints
BAR_WIDTH = 24


def duration(seconds: float) -> str:
    """Seconds as a person says them: "8 s", "2 min 05 s", "1 h 12 min"."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


class Progress:
    """`with Progress(total, "frames") as progress: ... progress.advance()`, to stderr."""

    def __init__(self, total: int, unit: str, stream: TextIO | None = None) -> None:
        self.total, self.unit = total, unit
        self.stream = sys.stderr if stream is None else stream
        self.done = 0
        self.started = time.perf_counter()
        self._printed_at = 0.0
        self._bar = self.stream.isatty()

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar and self.done:
            self.stream.write("\n")

    def advance(self, count: int = 1) -> None:
        """Count work done, and show it where it is time to."""
        self.done += count
        if self._bar:
            if self.done == self.total or time.perf_counter() - self._printed_at > 0.1:
                self._printed_at = time.perf_counter()
                self.stream.write("\r\x1b[K" + self.line(bar=True))
        elif self._line_is_due(count):
            self.stream.write(self.line(bar=False) + "\n")
        self.stream.flush()

    def line(self, *, bar: bool) -> str:
        """What is shown now, as one line."""
        elapsed = max(time.perf_counter() - self.started, 1e-9)
        rate = self.done / elapsed
        left = (self.total - self.done) / rate if self.done else 0.0
        filled = BAR_WIDTH * self.done // max(self.total, 1)
        front = f"[{'#' * filled}{'.' * (BAR_WIDTH - filled)}] " if bar else ""
        return f"{front}{self.done}/{self.total} {self.unit}, {rate:.2f} per second, {duration(left)} left"

    def message(self, text: str) -> None:
        """A line of its own above the bar."""
        self.stream.write(("\r\x1b[K" if self._bar else "") + text + "\n")
        self.stream.flush()

    def _line_is_due(self, count: int) -> bool:
        step = max(1, self.total // LINES_ON_A_PIPE)
        return self.done == self.total or self.done // step != (self.done - count) // step
