"""The table of published weights: sources.toml of the package, extended by the user's own file."""

import os
import re
from collections.abc import Mapping
from importlib import resources
from pathlib import Path, PurePosixPath
from urllib.parse import unquote, urlsplit

import msgspec

from bevcli.errors import ConfigError
from bevcli.parsing.documents import TOML_BYTES, parse_toml
from bevcli.parsing.files import read_text
from bevcli.user_folders import user_folder

_HUB = re.compile(r"hf://([\w.-]+/[\w.-]+?)(?:@([\w./-]+?))?/((?!.*\.\./)[\w./ -]+)")
_NAME = re.compile(r"\w[\w.+-]{0,99}")


class Source(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A table of sources.toml.

    Attributes:
        source: a URL, hf://OWNER/REPOSITORY[@REVISION]/FILE or a path; "" if it can be had by hand only.
        page: where a person finds the file; "" if `source` says it.
        model: name or TOML file of the model that the weights fit; "" for the name of the table.
        bytes: size of the file; None if it is not known.
        sha256: hexadecimal hash of the file, or at least its first 8 digits; "" if it is not known.
        licence: of the weights, such as "Apache-2.0".
        published: scores on the nuScenes validation split, by name, 0 to 1; errors in their units.
    """

    source: str = ""
    page: str = ""
    model: str = ""
    bytes: int | None = None
    sha256: str = ""
    licence: str = ""
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
        found = _HUB.fullmatch(self.source)
        if found:
            hub = (os.environ.get("HF_ENDPOINT") or "https://huggingface.co").rstrip("/")
            return f"{hub}/{found[1]}/resolve/{found[2] or 'main'}/{found[3]}"
        return self.source if "://" in self.source else ""

    @property
    def file_name(self) -> str:
        """The name of the downloaded file."""
        return re.sub(r"[^\w.+-]", "_", unquote(PurePosixPath(urlsplit(self.url).path).name))

    @property
    def path(self) -> Path | None:
        """The file, where the source is a path: it is used where it lies."""
        return Path(os.path.expanduser(self.source)) if self.source and not self.url else None


def own_table() -> Path:
    """The file in which a user adds sources, $XDG_CONFIG_HOME/bevcli/weights.toml (default ~/.config)."""
    return user_folder("XDG_CONFIG_HOME", ".config") / "weights.toml"


def read_sources() -> dict[str, Source]:
    """All sources by name; those of the user's own file replace those of the package. Raises ConfigError."""
    text = resources.files("bevcli").joinpath("weights", "sources.toml").read_text(encoding="utf-8")
    found = _parse(text, "sources.toml")
    own = own_table()
    if own.is_file():
        found |= _parse(read_text(own, TOML_BYTES, error=ConfigError), str(own))
    return found


def _parse(text: str, file: str) -> dict[str, Source]:
    found = {}
    for name, table in parse_toml(text, file, ConfigError).items():
        if not _NAME.fullmatch(name):
            raise ConfigError(f"{file}: [{name:.60}]: expected a name of letters, digits and - . + _")
        try:
            found[name] = msgspec.convert(table, Source)
        except msgspec.ValidationError as error:
            raise ConfigError(f"{file}: [{name}]: {error}") from None
    return found
