"""Weights by name: `fetch_weights` downloads and checks them; `weights_file` finds what is on this machine."""

import contextlib
import hashlib
import os
from dataclasses import dataclass, replace
from pathlib import Path

from bevcli.checkpoints import bundled_weights, expected_state, read_checkpoint, require_fit
from bevcli.config import load_config
from bevcli.errors import BevcliError, WeightsError
from bevcli.published import own_table
from bevcli.weights.cache import HASHES, Known, NamedWeights, named_weights
from bevcli.weights.download import Report, download
from bevcli.writing import output_errors

PARTIAL = ".partial-"  # before the name of a file that is being downloaded


@dataclass(frozen=True)
class FetchedWeights:
    """A file of weights that was checked.

    Attributes:
        path: the file.
        known: its hash and size.
        checked: how much of its hash was known before: "all", "the first N digits", "as at its first download", or
            "nothing", where only size, keys and shapes were.
    """

    path: Path
    known: Known
    checked: str


def fetch_weights(
    weights: NamedWeights, report: Report = lambda done, total: None, *, force: bool = False
) -> FetchedWeights:
    """The file of weights, downloaded if it is not there, and checked.

    The whole hash is checked if it is known. Else size, keys and shapes are; the hash is remembered, and every later
    download must have it. A file that is refused is deleted. A source that is a path is checked where it lies.

    Args:
        weights: of `named_weights`.
        report: called with the bytes that are there, and with the size of the file or None.
        force: download a file that is there once more.

    Raises:
        WeightsError: there is no source, the download fails, or the file is not the expected one.
        OutputError: it cannot be written.
    """
    if weights.file is None:
        raise WeightsError(f"{weights.name}: {by_hand(weights)}")
    if weights.source.path is not None or (not force and weights.here is not None):
        return _check(weights, weights.file)
    partial = weights.file.with_name(PARTIAL + weights.file.name)
    with output_errors(weights.file.parent):
        weights.file.parent.mkdir(parents=True, exist_ok=True)
    download(weights.source.url, partial, weights.source.bytes, report)
    try:
        found = _check(weights, partial)
    except BevcliError as error:
        _remove(partial)
        reason = str(error).replace(f"{partial}: ", "the file ", 1).replace(str(partial), "the file")
        raise WeightsError(f"{weights.source.url}: refused, and deleted: {reason}") from None
    weights.remember(found.known)
    os.replace(partial, weights.file)
    _remove(partial)
    return replace(found, path=weights.file)


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


def by_hand(weights: NamedWeights) -> str:
    """How to get weights that have no source."""
    where = weights.source.page or "its publisher"
    return (
        f"can only be downloaded by hand, from {where}: run the model with `weights=FILE`, or state the file "
        f"as `source` of [{weights.name}] in {own_table()}"
    )


def _check(weights: NamedWeights, path: Path) -> FetchedWeights:
    """The facts of a file that is the expected one. Raises WeightsError for another one."""
    if not path.is_file():
        raise WeightsError(f"{path}: weights file not found (the `source` of [{weights.name}])")
    with path.open("rb") as file:
        found = Known(hashlib.file_digest(file, "sha256").hexdigest(), path.stat().st_size)
    source, before = weights.source, weights.known
    if source.bytes not in (None, found.bytes):
        raise WeightsError(f"{path}: has {found.bytes:,} bytes (expected {source.bytes:,})")
    if not found.sha256.startswith(source.sha256):
        raise WeightsError(f"{path}: has the SHA-256 {found.sha256} (expected {source.sha256})")
    if before is not None and before != found:
        raise WeightsError(
            f"{path}: has the SHA-256 {found.sha256}, but the first download had {before.sha256}: the file at the "
            f"source has changed; if you trust it, remove its line from {weights.folder / HASHES}"
        )
    config = load_config(weights.name)
    require_fit(read_checkpoint(path), config.name, expected_state(config))
    digits = len(source.sha256)
    if digits == 64:
        return FetchedWeights(path, found, "all")
    if before is not None:
        return FetchedWeights(path, found, "as at its first download")
    return FetchedWeights(path, found, f"the first {digits} digits" if digits else "nothing")


def _remove(partial: Path) -> None:
    for path in (partial, partial.with_name(f"{partial.name}.json")):
        with contextlib.suppress(OSError):
            path.unlink()
