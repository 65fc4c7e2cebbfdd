"""Downloads of weights with a bar on stderr."""

from contextlib import ExitStack
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


def fetch_with_bar(weights: "NamedWeights", *, force: bool = False) -> "FetchedWeights":
    """The file of weights, downloaded if it is not there. Ctrl-C ends the command; what has come is kept."""
    from bevcli.weights.fetch import fetch_weights

    bar: Progress | None = None

    def show(done: int, total: int | None) -> None:
        """The bar starts when the size is known; total is None if the server does not state it."""
        nonlocal bar
        if bar is None:
            note = f"{weights.name}: {weights.source.url}"
            bar = shown.enter_context(Progress(max(total or 0, done + UNIT) // UNIT, "MB", [note]))
            bar.skip(done // UNIT)
        bar.reach(done // UNIT)

    with ExitStack() as shown:
        try:
            return fetch_weights(weights, show, force=force)
        except KeyboardInterrupt:
            say("stopped; the same command goes on from here", err=True)
            raise typer.Exit(STOPPED) from None


def fetch_if_asked(options: ModelOptions) -> None:
    """Download the weights of a model, where `fetch` asks for it and they are not there."""
    if not options.fetch or options.weights is not None or options.untrained:
        return
    from bevcli.weights.cache import find_weights

    named = find_weights(str(options.model), options.weights_dir)
    if named is not None and named.here is None:
        fetch_with_bar(named)
