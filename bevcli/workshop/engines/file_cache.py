"""Exported files of models that are run by name, in the user's cache.

They lie in $XDG_CACHE_HOME/bevcli/engines (default ~/.cache/bevcli/engines). A file is written aside and renamed, so
that several processes may make it at the same time. Files that nobody has used for some months are removed.
"""

import os
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import msgspec

from bevcli.errors import ConfigError, WeightsError
from bevcli.parsing.files import MIB, read_bytes
from bevcli.user_folders import user_cache
from bevcli.workshop.engines.box_differences import BoxDifferences
from bevcli.workshop.engines.exported import ExportedModel, load_exported
from bevcli.writing import whole_file, write_whole

UNUSED_S = 90 * 24 * 3600.0


class FileFacts(msgspec.Struct, frozen=True):
    """The facts of a file.

    Attributes:
        sha256: of the file, hexadecimal.
        calibrated_with: name of the drive whose frames calibrated it; "" for float32.
        differences: by engine.
    """

    sha256: str
    calibrated_with: str = ""
    differences: Mapping[str, BoxDifferences] = {}


@dataclass(frozen=True)
class EngineFile:
    """A file of the cache. key: hash of everything that its contents depend on."""

    key: str

    @property
    def path(self) -> Path:
        """The exported file."""
        return engines_folder() / f"{self.key}.onnx"

    @property
    def _facts(self) -> Path:
        return self.path.with_suffix(".json")

    @property
    def stamp(self) -> tuple[object, ...]:
        """What changes with the file: both paths, inodes and sizes; empty where it is not there."""
        try:
            found = [(path, path.stat()) for path in (self.path, self._facts)]
        except OSError:
            return ()
        return tuple((path, stat.st_ino, stat.st_size) for path, stat in found)

    def load(self, engine: str) -> tuple[ExportedModel, FileFacts] | None:
        """The file in an engine, and its facts; None if it is not there, or broken.

        Raises BevcliError where the engine is not installed.
        """
        try:
            facts = msgspec.json.decode(read_bytes(self._facts, MIB, error=WeightsError), type=FileFacts)
            network = load_exported(self.path, engine)
        except (msgspec.MsgspecError, ValueError, RecursionError, WeightsError, ConfigError):
            return None
        if bytes(network.digest.tolist()).hex() != facts.sha256:
            return None
        with suppress(OSError):  # a cache that cannot be written can be read
            os.utime(self.path)
        return network, facts

    def make(self, write: Callable[[Path], None], calibrated_with: str, engine: str) -> tuple[ExportedModel, FileFacts]:
        """Write the file, and load it. Raises OutputError, and what `write` raises."""
        _remove_unused(self.path.parent)
        with whole_file(self.path, parents=True, shared=True) as unfinished:
            write(unfinished)
        network = load_exported(self.path, engine)
        facts = FileFacts(bytes(network.digest.tolist()).hex(), calibrated_with)
        self.state(facts)
        return network, facts

    def state(self, facts: FileFacts) -> None:
        """Write the facts. Raises OutputError."""
        write_whole(self._facts, msgspec.json.encode(facts), shared=True)


def engines_folder() -> Path:
    """The folder of exported files and of measured speeds."""
    return user_cache() / "engines"


def _remove_unused(folder: Path) -> None:
    """Remove files that were not used for a long time, and what a killed process has left."""
    for path in folder.glob("*.onnx") if folder.is_dir() else ():
        with suppress(OSError):
            if time.time() - path.stat().st_mtime > UNUSED_S:
                path.unlink()
                path.with_suffix(".json").unlink(missing_ok=True)
