"""Errors caused by a user's mistake, and findings about a calibration.

The command line prints the message of an error on one line and exits with code 1.

A message states what is wrong and where, what was expected and found, and what to do:
``calibration.json: camera CAM_BACK: "intrinsics" is missing (expected 3x3)``.
"""

import re
from collections.abc import Iterable
from concurrent.futures import Future, TimeoutError as FutureTimeout
from dataclasses import dataclass
from typing import Literal, TypeVar

from bevcli.printing import LONGEST_LIST, one_line

T = TypeVar("T")
_LONG_WORD = re.compile(rf"\S{{{LONGEST_LIST},}}")  # longer than the path of any usual file


class BevcliError(Exception):
    """A mistake in the user's input. The message is one line and is understandable without a traceback.

    A long word, such as a value of a file, is shortened, and so is the whole message.
    """

    def __init__(self, *arguments: object) -> None:
        texts = (_LONG_WORD.sub(lambda word: one_line(word[0], LONGEST_LIST), str(each)) for each in arguments)
        super().__init__(*texts)

    def __str__(self) -> str:
        return one_line(super().__str__())


class InputError(BevcliError):
    """A sequence, calibration, ego-motion or ground-truth file is missing or invalid, or an option does not fit it."""


class ConfigError(BevcliError):
    """A model's TOML file is missing or invalid."""


class WeightsError(BevcliError):
    """A weights file is missing, invalid, or belongs to another model."""


class OutputError(BevcliError):
    """An output cannot be written to the given path."""


class WaitError(BevcliError):
    """A disk, a network folder, a viewer or another process has not answered in time.

    A thread may still wait for it, so the command line then ends the process without waiting for its threads.
    """


def result_within(future: Future[T], seconds: float, what: str) -> T:
    """The result of a task in another thread. An exception of the task is raised here.

    what: what the task does, for the error message: "reading frame 7".
    Raises WaitError if the task takes longer. Its thread goes on.
    """
    try:
        return future.result(seconds)
    except FutureTimeout:
        if future.done():  # the exception of the task itself, such as a network folder's time-out
            raise
        raise WaitError(f"{what}: no answer within {seconds:.0f} s") from None


Severity = Literal["error", "warning", "info"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "info")


@dataclass(frozen=True)
class Finding:
    """One finding about a calibration or sequence."""

    code: str  # stable name of the kind of finding, listed in docs/calibration.md
    severity: Severity  # "error", "warning" or "info"
    camera: str | None  # name of the camera, None for the whole rig
    message: str  # what is wrong
    found: str = ""  # the value found, with its unit; "" if there is none
    expected: str = ""  # the value expected, with its unit; "" if there is none
    advice: str = ""  # what to do; "" if there is none

    @property
    def line(self) -> str:
        """The finding on one line: `camera CAM_BACK: "intrinsics" is missing (expected 3x3)`."""
        prefix = f"camera {self.camera}: " if self.camera else ""
        numbers = [f"{word} {value}" for word, value in (("expected", self.expected), ("found", self.found)) if value]
        brackets = f" ({', '.join(numbers)})" if numbers else ""
        return f"{prefix}{self.message}{brackets}" + (f": {self.advice}" if self.advice else "")


def errors_of(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """The findings of severity "error", in their order."""
    return tuple(finding for finding in findings if finding.severity == "error")
