"""The files of a model's further results, by their type."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

from bevcli.frame import Ground, MapLines, Plan
from bevcli.sequences.files.lines_file import LinesWriter
from bevcli.sequences.files.plan_file import PlanWriter


class Growing(Protocol):
    """A file that is written piece by piece."""

    @property
    def size(self) -> int:
        """Bytes that a later writer keeps."""

    def is_deleted(self) -> bool:
        """True if somebody has deleted the file."""


class ResultWriter(Protocol):
    """Writes one type of results, frame by frame.

    Attributes:
        name: of the file.
    """

    name: str

    def __init__(
        self, path: Path, frame_of_reference: str, extras: Mapping[str, Any], resume_at: int | None = None
    ) -> None: ...

    @property
    def file(self) -> Growing: ...

    def write(self, ground: Ground, result: Any) -> None: ...

    def close(self) -> None: ...


RESULT_WRITERS: Mapping[type, type[ResultWriter]] = {MapLines: LinesWriter, Plan: PlanWriter}
