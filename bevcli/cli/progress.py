"""Progress of a command on stderr: a bar on a terminal, about ten plain lines on a pipe."""

import os
import re
import sys
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO, TypeVar

from bevcli.inference import ModelOptions
from bevcli.printing import duration, one_line, say

if TYPE_CHECKING:
    import rich.progress

    from bevcli.frame import Drive
    from bevcli.inference.load import Model
    from bevcli.sequences.options import InputOptions

T = TypeVar("T")

LINES_ON_A_PIPE = 10  # about this many progress lines for a whole run
SLOW_S = 2.0  # work whose units take longer also gets a line after the first one, and its pace in seconds
LONGEST_SILENCE_S = 30.0  # between two lines on a pipe, if units are done meanwhile
OPENING_S = 8.0  # of a drive that is opened, until a line says so


class Progress:
    """Shows the work done, the rate and the time left.

    Use it as `with Progress(total, "frames") as progress: ... progress.advance()`. Its attribute `detail` is a text
    after them, such as "loss 1.2".

    Args:
        total: the amount of work, in units.
        unit: the plural of the unit, such as "frames".
        notes: printed at the start, each once.
    """

    def __init__(self, total: int, unit: str, notes: Iterable[str] = ()) -> None:
        self.total, self.unit, self._notes = total, unit, dict.fromkeys(notes)
        self.stream = sys.stderr
        self.done = 0
        self.detail = ""
        self.skipped = 0
        self.started = self._printed = time.perf_counter()
        self._bar: rich.progress.Progress | None = None

    def __enter__(self) -> "Progress":
        if self.stream.isatty() and os.environ.get("TERM") not in ("dumb", "unknown"):
            self._bar = _bar(self.stream)
            self._bar.add_task("", total=self.total, state=self.state())
            self._bar.start()
        for note in self._notes:
            for line in re.split(r"\n(?=  )", f"note: {note}"):  # rows of a table are indented
                self.message(line)
        return self

    def __exit__(self, *error: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def advance(self, count: int = 1) -> None:
        """Adds units of work that are done."""
        self.done += count
        if self._bar is not None:
            self._bar.update(self._bar.task_ids[0], completed=self.done, state=self.state())
            return
        step, now = max(1, self.total // LINES_ON_A_PIPE), time.perf_counter()
        is_slow_first = self.done == count and now - self.started >= SLOW_S
        is_next = self.done == self.total or self.done // step != (self.done - count) // step
        if is_slow_first or is_next or now - self._printed >= LONGEST_SILENCE_S:
            print(self.state(), file=self.stream, flush=True)
            self._printed = time.perf_counter()

    def over(self, parts: Iterable[T]) -> Iterator[T]:
        """The parts of some work, each of which adds a unit."""
        for part in parts:
            self.advance()
            yield part

    def reach(self, done: int) -> None:
        """Adds units of work up to this number of them."""
        if done > self.done:
            self.advance(done - self.done)

    def skip(self, count: int) -> None:
        """Adds units of work that were done before: they do not count for the rate."""
        self.skipped = count
        self.advance(count)

    def message(self, text: str) -> None:
        """Print a line, above the bar if there is one. The command's arguments in backticks become flags."""
        text = one_line(text)
        if self._bar is not None:
            self._bar.console.print(text, markup=False, highlight=False, emoji=False, soft_wrap=True)
        else:
            print(text, file=self.stream, flush=True)

    def state(self) -> str:
        """The progress in words, such as "3/8 frames, 0.35 per second, 14 s left"."""
        if self.done == self.skipped:
            return f"{self.done}/{self.total} {self.unit}"
        unit_s = max(time.perf_counter() - self.started, 1e-9) / (self.done - self.skipped)
        pace = f"{1 / unit_s:.2f} per second" if unit_s <= SLOW_S else f"{unit_s:.1f} s each"
        remaining = f"{duration((self.total - self.done) * unit_s)} left"
        return ", ".join(filter(None, (f"{self.done}/{self.total} {self.unit}", pace, remaining, self.detail)))


def _bar(stream: TextIO) -> "rich.progress.Progress":
    from rich import console, progress

    return progress.Progress(
        progress.BarColumn(),
        progress.TextColumn("{task.fields[state]}", markup=False),
        console=console.Console(file=stream),
        redirect_stdout=False,  # a command's results may be piped
    )


def open_with_bar(path: Path, options: "InputOptions", format_options: Mapping[str, Any]) -> "Drive":
    """Open a drive, with a bar where the option `odometry` measures its motion, and lines where all else takes long."""
    from bevcli.sequences.open import open_steps

    with opening(path) as told:
        return last_of_steps(open_steps(path, options, **format_options), told)


@contextmanager
def opening(path: Path) -> Iterator[threading.Event]:
    """Print that an input is being opened after OPENING_S, then after ever longer times, until the event is set."""
    told = threading.Event()
    threading.Thread(target=_tell_opening, args=(path, told), daemon=True).start()
    try:
        yield told
    finally:
        told.set()


def _tell_opening(path: Path, told: threading.Event) -> None:
    started, silence = time.perf_counter(), OPENING_S
    while not told.wait(silence):
        say(f"opening {path}, {duration(time.perf_counter() - started)} so far", err=True)
        silence *= 2


def last_of_steps(steps: Iterable[tuple[int, int] | T], told: threading.Event | None = None) -> T:
    """The last of some items. Those before it are shown: steps of the ego-motion that are measured, and of how many.

    told: of `opening`, set by the first item.
    """
    bar: Progress | None = None
    with ExitStack() as shown:
        for step in steps:
            if told is not None:
                told.set()
            if not isinstance(step, tuple):
                return step
            done, total = step
            if bar is None or done == 0:
                shown.close()
                bar = shown.enter_context(Progress(total, "steps of the ego-motion"))
            bar.reach(done)
    raise AssertionError("steps end with what they lead to")


def load_with_bar(options: ModelOptions, drives: Sequence[Path] | None = ()) -> tuple["Model", tuple[str, ...]]:
    """The model of the options, or one of the package for the drives, and a note on that choice (`choose_model`).

    Its weights are downloaded where `fetch` asks for it and they are not there.
    """
    from bevcli.inference.load import choose_model, load_model, weights_to_fetch

    options, notes = choose_model(options, drives)
    weights = weights_to_fetch(options)
    if weights is not None:
        from bevcli.workshop.weights.commands import fetch_with_bar

        fetch_with_bar(weights)
    return load_model(options=options), notes
