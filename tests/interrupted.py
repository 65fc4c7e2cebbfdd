"""Runs that end before their drive does."""

from pathlib import Path

import pytest

from bevcli.frame import DerivedDrive, Drive, Frame
from bevcli.inference.load import Model
from bevcli.runs import RunOptions
from bevcli.runs.run_into_folder import run_into_folder


class Interrupted(DerivedDrive):
    """A drive that the user interrupts when the frame at an index is due."""

    def __init__(self, drive: Drive, index: int) -> None:
        super().__init__(drive)
        self._index = index

    def load(self, index: int) -> Frame:
        if index == self._index:
            raise KeyboardInterrupt
        return super().load(index)


def run_frames(
    count: int, model: Model, drive: Drive, out: Path, options: RunOptions | None = None, *, resume: bool = False
) -> None:
    """Run the first frames of a drive, as many as can be run without the frame at the index `count`."""
    with pytest.raises(KeyboardInterrupt):
        run_into_folder(model, Interrupted(drive, count), out, options, resume=resume)
