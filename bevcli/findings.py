"""A finding: one mistake or oddity in a calibration or sequence, with numbers and advice."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

Severity = Literal["error", "warning", "info"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "info")


@dataclass(frozen=True)
class Finding:
    """One finding about a calibration or sequence.

    Attributes:
        code: stable name of the kind of finding, listed in docs/calibration.md.
        severity: "error", "warning" or "info".
        camera: name of the camera, None for the whole rig.
        message: what is wrong.
        found: the value found, with its unit; "" if there is none.
        expected: the value expected, with its unit; "" if there is none.
        advice: what to do; "" if there is none.
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
        """The finding on one line: `camera CAM_BACK: "intrinsics" is missing (expected 3x3)`."""
        prefix = f"camera {self.camera}: " if self.camera else ""
        numbers = [f"{word} {value}" for word, value in (("expected", self.expected), ("found", self.found)) if value]
        brackets = f" ({', '.join(numbers)})" if numbers else ""
        return f"{prefix}{self.message}{brackets}" + (f": {self.advice}" if self.advice else "")


def errors_of(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """The findings of severity "error", in their order."""
    return tuple(finding for finding in findings if finding.severity == "error")
