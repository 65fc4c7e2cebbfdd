"""`weights_file`: weights by the path of their file, or by the name of a model."""

from pathlib import Path

from bevcli.checkpoints import bundled_weights
from bevcli.errors import WeightsError
from bevcli.weights.cache import named_weights
from bevcli.weights.fetch import by_hand


def weights_file(path_or_name: Path) -> Path:
    """The file at a path, or the weights of a model's name: those of the package, or downloaded ones.

    Raises WeightsError for a name without a file on this machine.
    """
    name = str(path_or_name)
    if path_or_name.suffix or path_or_name.is_file():
        return path_or_name
    bundled = bundled_weights(name)
    if bundled is not None:
        return bundled
    named = named_weights(name)
    if named.here is None:
        how = by_hand(named) if named.file is None else f"are not there yet: run `bevcli weights fetch {name}`"
        raise WeightsError(f"the weights of {name} {how}")
    return named.here
