"""The export of a model to another engine with a bar on stderr."""

from typing import TYPE_CHECKING

from bevcli.cli.progress import Progress

if TYPE_CHECKING:
    from bevcli.frame import Sequence
    from bevcli.inference.load import Model


class EngineBar:
    """The progress of the export: its bar starts with the first step, because there may be none."""

    def __init__(self) -> None:
        self._progress: Progress | None = None
        self._said = ""

    def show(self, done: int, total: int, what: str) -> None:
        """Show the steps that are done, and say what is done where that has changed. A new export gets a new bar."""
        if self._progress is None or done < self._progress.done:
            self.__exit__()
            once = "once for these weights, number of cameras and image size"
            self._progress = Progress(total, "steps", [f"{what}, {once}"]).__enter__()
        elif what != self._said and done < total:
            self._progress.message(f"note: {what}")
        self._said = what
        if done > self._progress.done:
            self._progress.advance(done - self._progress.done)

    def __enter__(self) -> "EngineBar":
        return self

    def __exit__(self, *error: object) -> None:
        if self._progress is not None:
            self._progress.__exit__()


def in_engine_with_bar(model: "Model", drive: "Sequence", parts: str = "") -> "Model":
    """The model in the engine that the options choose, see `in_engine`."""
    from bevcli.inference.in_engine import in_engine

    with EngineBar() as bar:
        return in_engine(model, drive.rig, drive, parts=parts, report=bar.show)
