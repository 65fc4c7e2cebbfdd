"""Published weights by name: where each is published, and the file on this machine.

The table of sources is sources.toml of the package, extended by the user's own file. Downloaded files lie in one
folder, with the hashes that were computed at their first download.
"""

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote, urlsplit

import msgspec

from bevcli.errors import ConfigError, WeightsError
from bevcli.parsing.documents import TOML_BYTES, parse_toml
from bevcli.parsing.files import MIB, read_bytes, read_text
from bevcli.writing import user_folder, weights_folder

HASHES = "hashes.json"

_HUB = re.compile(r"hf://([\w.-]+/[\w.-]+?)(?:@([\w./-]+?))?/((?!.*\.\./)[\w./ -]+)")
_NAME = re.compile(r"\w[\w.+-]{0,99}")


class Source(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A table of sources.toml."""

    source: str = ""  # a URL, hf://OWNER/REPOSITORY[@REVISION]/FILE or a path; "" if it can be had by hand only
    page: str = ""  # where a person finds the file; "" if `source` says it
    model: str = ""  # name or TOML file of the model that the weights fit; "" for the name of the table
    bytes: int | None = None  # size of the file; None if it is not known
    sha256: str = ""  # hexadecimal hash of the file, or at least its first 8 digits; "" if it is not known
    licence: str = ""  # of the weights, such as "Apache-2.0"
    # scores on the nuScenes validation split, by name, 0 to 1; errors in their units
    published: Mapping[str, float] = {}

    def __post_init__(self) -> None:
        if self.sha256 and not re.fullmatch(r"[0-9a-f]{8,64}", self.sha256):
            raise ValueError("sha256: expected 8 to 64 of the digits 0-9 and a-f")
        if self.bytes is not None and self.bytes <= 0:
            raise ValueError("bytes: expected a positive number")
        if self.source.startswith("hf://") and not _HUB.fullmatch(self.source):
            raise ValueError("source: expected hf://OWNER/REPOSITORY/FILE or hf://OWNER/REPOSITORY@REVISION/FILE")
        if "://" in self.source and not self.source.startswith(("https://", "http://", "hf://")):
            raise ValueError("source: expected https://…, http://…, hf://… or a path")
        if self.url and PurePosixPath(self.file_name).suffix not in (".pth", ".pt", ".safetensors"):
            raise ValueError("source: expected a file whose name ends in .pth, .pt or .safetensors")

    @property
    def url(self) -> str:
        """The address of the file; "" for a path, and where there is none.

        Files of the Hugging Face Hub are served under stable addresses, by a mirror where HF_ENDPOINT names one.
        """
        match = _HUB.fullmatch(self.source)
        if match:
            hub = (os.environ.get("HF_ENDPOINT") or "https://huggingface.co").rstrip("/")
            return f"{hub}/{match[1]}/resolve/{match[2] or 'main'}/{match[3]}"
        return self.source if "://" in self.source else ""

    @property
    def file_name(self) -> str:
        """The name of the downloaded file."""
        return re.sub(r"[^\w.+-]", "_", unquote(PurePosixPath(urlsplit(self.url).path).name))

    @property
    def path(self) -> Path | None:
        """The file, where the source is a path: it is used where it lies."""
        return Path(os.path.expanduser(self.source)) if self.source and not self.url else None


class Known(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A file as it was at its first download: its SHA-256, hexadecimal, and its size."""

    sha256: str
    bytes: int


@dataclass(frozen=True)
class NamedWeights:
    """A name of the table of sources, on this machine."""

    name: str  # such as "tiny"
    source: Source  # where it is published
    folder: Path  # the folder of all downloaded weights

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
        return read_hashes(self.folder).get(self.source.source)

    @property
    def size(self) -> int | None:
        """Bytes of the file; None if it is not known."""
        here = self.here
        return self.source.bytes if here is None else here.stat().st_size

    @property
    def by_hand(self) -> str:
        """How to get weights that have no source, for messages."""
        return (
            f"can only be downloaded by hand, from {self.source.page or 'its publisher'}: run the model with "
            f"`weights` (`--weights FILE`), or state the file as `source` of [{self.name}] in {own_table()}"
        )


@dataclass(frozen=True)
class HubModel:
    """A model of a hub, such as "hf:OWNER/NAME", on this machine."""

    contents: Mapping[str, Any]  # of its model file, as TOML would have them
    file: Path  # the file that states them, for errors
    weights: Path  # the file of its weights
    source: str  # its name and revision, for texts


def hub_model(name: str, *, fetch: bool = False) -> HubModel:
    """The model of a hub, downloaded if it is not on this machine.

    name: as of `is_of_hub`. fetch: look for a newer version of a model that is here. Raises BevcliError.
    """
    from bevcli.workshop.weights.hub import open_model

    return open_model(name, fetch=fetch)


def own_table() -> Path:
    """The file in which a user adds sources, $XDG_CONFIG_HOME/bevcli/weights.toml (default ~/.config)."""
    return user_folder("XDG_CONFIG_HOME", ".config") / "weights.toml"


def read_sources() -> dict[str, Source]:
    """All sources by name; those of the user's own file replace those of the package. Raises ConfigError."""
    package, own_file = resources.files("bevcli").joinpath("weights", "sources.toml"), own_table()
    texts = {"sources.toml": package.read_text(encoding="utf-8")}
    if own_file.is_file():
        texts[str(own_file)] = read_text(own_file, TOML_BYTES, error=ConfigError)
    sources = {}
    for file, text in texts.items():
        for name, table in parse_toml(text, file, ConfigError).items():
            if not _NAME.fullmatch(name):
                raise ConfigError(f"{file}: [{name:.60}]: expected a name of letters, digits and - . + _")
            try:
                sources[name] = msgspec.convert(table, Source)
            except msgspec.ValidationError as error:
                raise ConfigError(f"{file}: [{name}]: {error}") from None
    return sources


def all_weights(folder: Path | None = None) -> dict[str, NamedWeights]:
    """Every name of the table of sources. folder: of `weights_folder`. Raises ConfigError."""
    return {name: NamedWeights(name, source, weights_folder(folder)) for name, source in read_sources().items()}


def named_weights(name: str, folder: Path | None = None) -> NamedWeights:
    """A name of the table of sources. Raises WeightsError for another one."""
    weights = all_weights(folder)
    if name not in weights:
        if resources.files("bevcli").joinpath("weights", f"{name}.safetensors").is_file():
            raise WeightsError(f'the weights of "{name}" are in the package: pass `model={name}` (`--model {name}`)')
        raise WeightsError(f'no weights are known as "{name}" (expected one of {", ".join(weights)})')
    return weights[name]


def read_hashes(folder: Path) -> dict[str, Known]:
    """Source -> its file, of those that were downloaded into a folder. Raises WeightsError."""
    path = folder / HASHES
    if not path.exists():
        return {}
    try:
        return msgspec.json.decode(read_bytes(path, MIB, error=WeightsError), type=dict[str, Known])
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise WeightsError(f"{path}: broken ({error}): remove it, and the hashes are computed anew") from None
