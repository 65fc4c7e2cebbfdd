"""Downloads of weights with a bar on stderr."""

from typing import TYPE_CHECKING

import typer

from bevcli.cli.progress import Progress
from bevcli.inference.options import ModelOptions
from bevcli.printing import say

if TYPE_CHECKING:
    from bevcli.weights.cache import NamedWeights
    from bevcli.weights.fetch import FetchedWeights

STOPPED = 130  # exit code
UNIT = 1_000_000


class _Bar:
    """The progress of a download: its bar starts when the size is known."""

    def __init__(self, weights: "NamedWeights") -> None:
        self._weights = weights
        self._progress: Progress | None = None

    def show(self, done: int, total: int | None) -> None:
        """Show the bytes that are there. total: None if the server does not state it."""
        if self._progress is None:
            note = f"{self._weights.name}: {self._weights.source.url}"
            self._progress = Progress(max(total or 0, done + UNIT) // UNIT, "MB", [note]).__enter__()
            self._progress.skip(done // UNIT)
        if done // UNIT > self._progress.done:
            self._progress.advance(done // UNIT - self._progress.done)

    def close(self) -> None:
        if self._progress is not None:
            self._progress.__exit__()


def fetch_with_bar(weights: "NamedWeights", *, force: bool = False) -> "FetchedWeights":
    """The file of weights, downloaded if it is not there. Ctrl-C ends the command; what has come is kept."""
    from bevcli.weights.fetch import fetch_weights

    bar = _Bar(weights)
    try:
        return fetch_weights(weights, bar.show, force=force)
    except KeyboardInterrupt:
        say("stopped; the same command goes on from here", err=True)
        raise typer.Exit(STOPPED) from None
    finally:
        bar.close()


def fetch_if_asked(options: ModelOptions) -> None:
    """Download the weights of a model, where `fetch` asks for it and they are not there."""
    if not options.fetch or options.weights is not None or options.untrained:
        return
    from bevcli.weights.cache import find_weights

    named = find_weights(str(options.model), options.weights_dir)
    if named is not None and named.here is None:
        fetch_with_bar(named)
