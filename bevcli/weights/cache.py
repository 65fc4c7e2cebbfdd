"""Weights by name: the folder where downloaded files lie, and the hashes that were computed at their first download."""

import os
from dataclasses import dataclass
from pathlib import Path

import msgspec

from bevcli.errors import WeightsError
from bevcli.parsing.files import MIB, read_bytes
from bevcli.published import Source, read_sources
from bevcli.user_folders import user_cache
from bevcli.writing import write_whole

VARIABLE = "BEVCLI_WEIGHTS_DIR"
HASHES = "hashes.json"


class Known(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A file as it was at its first download: its SHA-256, hexadecimal, and its size."""

    sha256: str
    bytes: int


@dataclass(frozen=True)
class NamedWeights:
    """A name of the table of sources, on this machine.

    Attributes:
        name: such as "tiny".
        source: where it is published.
        folder: the folder of all downloaded weights.
    """

    name: str
    source: Source
    folder: Path

    @property
    def model(self) -> str:
        """Name or TOML file of the model that the weights fit."""
        return self.source.model or self.name

    @property
    def file(self) -> Path | None:
        """The file, which may not be there yet; None where there is no source."""
        if self.source.path is not None:
            return self.source.path
        return self.folder / self.name / self.source.file_name if self.source.url else None

    @property
    def here(self) -> Path | None:
        """The file if it is on this machine, and whole if it was downloaded."""
        file = self.file
        if file is None or not file.is_file():
            return None
        whole = self.source.path is not None or self.known is None or file.stat().st_size == self.known.bytes
        return file if whole else None

    @property
    def known(self) -> Known | None:
        """The file as it was at the first download from its source; None before. Raises WeightsError."""
        return _read_hashes(self.folder).get(self.source.source)

    @property
    def size(self) -> int | None:
        """Bytes of the file; None if it is not known."""
        here = self.here
        return self.source.bytes if here is None else here.stat().st_size

    def remember(self, known: Known) -> None:
        """Store the hash of a file that was downloaded. Raises OutputError."""
        hashes = {**_read_hashes(self.folder), self.source.source: known}
        content = msgspec.json.format(msgspec.json.encode(hashes), indent=1)
        write_whole(self.folder / HASHES, content + b"\n", parents=True, shared=True)


def weights_folder(chosen: Path | None = None) -> Path:
    """The folder of downloaded weights: the chosen one, $BEVCLI_WEIGHTS_DIR, or ~/.cache/bevcli/weights."""
    named = os.environ.get(VARIABLE)
    return chosen or (Path(named) if named else user_cache() / "weights")


def all_weights(folder: Path | None = None) -> dict[str, NamedWeights]:
    """Every name of the table of sources. folder: of `weights_folder`. Raises ConfigError."""
    return {name: NamedWeights(name, source, weights_folder(folder)) for name, source in read_sources().items()}


def named_weights(name: str, folder: Path | None = None) -> NamedWeights:
    """A name of the table of sources. Raises WeightsError for another one."""
    known = all_weights(folder)
    if name not in known:
        raise WeightsError(f'no weights are known as "{name}" (expected one of {", ".join(known)})')
    return known[name]


def _read_hashes(folder: Path) -> dict[str, Known]:
    path = folder / HASHES
    if not path.exists():
        return {}
    try:
        return msgspec.json.decode(read_bytes(path, MIB, error=WeightsError), type=dict[str, Known])
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise WeightsError(f"{path}: broken ({error}): remove it, and the hashes are computed anew") from None
