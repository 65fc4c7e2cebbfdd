"""What a check of a calibration found: one mistake or oddity, with its numbers and what to do about it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

Severity = Literal["error", "warning", "info"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "info")


@dataclass(frozen=True)
class Finding:
    """One thing to say about a calibration.

    code: stable name of the kind, listed in docs/calibration.md. camera: which one, None for the whole rig.
    message: what is wrong. found, expected: the numbers with their units, "" where there is none.
    advice: what to do.
    """

    code: str
    severity: Severity
    camera: str | None
    message: str
    found: str = ""
    expected: str = ""
    advice: str = ""

    @property
    def line(self) -> str:
        """All of it on one line: `camera CAM_BACK: "intrinsics" is missing (expected 3x3)`."""
        where = f"camera {self.camera}: " if self.camera else ""
        numbers = [f"{word} {value}" for word, value in (("expected", self.expected), ("found", self.found)) if value]
        brackets = f" ({', '.join(numbers)})" if numbers else ""
        return f"{where}{self.message}{brackets}" + (f": {self.advice}" if self.advice else "")


def errors_of(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Those of severity error, in their order."""
    return tuple(finding for finding in findings if finding.severity == "error")
