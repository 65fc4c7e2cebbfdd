"""The drives of a batch: from arguments and lists to single drives, each with a hash of its input."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

from bevcli.batch.nuscenes_url import copy_tables, versions_at
from bevcli.batch.storage import StoredFile, expand, is_url, open_storage
from bevcli.errors import BevcliError, InputError
from bevcli.parsing.files import MIB, read_text
from bevcli.sequences.nuscenes.cache import open_index
from bevcli.sequences.nuscenes.choice import NuScenesChoice, chosen_scenes, is_nuscenes_root, tables_of

LISTING_THREADS = 32  # listing a folder in an object store is waiting
LONGEST_NAME = 80
_KEY_DIGITS = 12


@dataclass(frozen=True)
class Drive:
    """One drive of a batch.

    Attributes:
        source: path or URL of its folder or file, or of the nuScenes root that contains it.
        name: short name, for the folder of its results.
        scene: of a nuScenes root, None for other inputs.
        input_hash: hash of the name and of names, sizes and versions of the files; "" if they could not be listed.
        problem: why it cannot be run, "" if nothing is known.
    """

    source: str
    name: str
    scene: str | None = None
    input_hash: str = ""
    problem: str = ""

    def result(self, job_hash: str) -> str:
        """The name of the folder of its results: other input, model, weights or options have another name."""
        key = hashlib.sha256(f"{self.input_hash or self.source} {job_hash}".encode()).hexdigest()
        return f"{self.name}-{key[:_KEY_DIGITS]}"


def read_list(path: Path) -> list[str]:
    """The drives in a text file: one path, URL or pattern per line; "#" starts a comment. Raises InputError."""
    lines = (line.strip() for line in read_text(path, 256 * MIB).splitlines())
    found = [line for line in lines if line and not line.startswith("#")]
    if not found:
        raise InputError(f"{path}: contains no drive (expected one path or URL per line)")
    return found


def find_drives(
    texts: Sequence[str], choice: NuScenesChoice = NuScenesChoice(), listed: Callable[[int], None] = lambda count: None
) -> tuple[list[Drive], tuple[str, ...]]:
    """All drives of arguments, and notes for the user.

    Args:
        texts: paths, URLs and glob patterns. A nuScenes root gives one drive per scene.
        choice: the part of a nuScenes root.
        listed: called with the number of drives whose files have been listed so far.

    Returns:
        The drives in order, each input once. A drive whose input cannot be listed has its `problem`.

    Raises:
        InputError: a pattern matches nothing, or there are no drives.
    """
    sources = dict.fromkeys(source.rstrip("/") or source for text in texts for source in expand(text))
    drives: list[Drive] = []
    with ThreadPoolExecutor(LISTING_THREADS) as pool:
        for found in pool.map(lambda source: list(_drives_of(source, choice)), sources):
            drives += found
            listed(len(drives))
    if not drives:
        raise InputError("there are no drives (expected paths, URLs or patterns, or --list FILE)")
    return _without_copies(drives)


def _drives_of(source: str, choice: NuScenesChoice) -> Iterator[Drive]:
    path = source if is_url(source) else str(Path(source.removeprefix("file://")).absolute())
    drive = Drive(path, _safe_name(path))
    try:
        storage = open_storage(path)
        if versions_at(storage) if is_url(path) else is_nuscenes_root(Path(path)):
            yield from _scenes(drive, choice)
        else:
            yield replace(drive, input_hash=_hash(drive.name, None, storage.files()))
    except BevcliError as error:
        yield replace(drive, problem=str(error))


def _scenes(root: Drive, choice: NuScenesChoice) -> Iterator[Drive]:
    """A drive per scene. Of the input, the tables count."""
    if is_url(root.source):
        tables, files = copy_tables(root.source, choice.version)
    else:
        tables = tables_of(Path(root.source), choice.version)
        files = open_storage(str(tables)).files()
    index, _ = open_index(tables)
    for number in chosen_scenes(index, tables, choice):
        scene = str(index.scenes.names[number])
        yield Drive(root.source, _safe_name(scene), scene, _hash(tables.name, scene, files))


def _hash(name: str, scene: str | None, files: list[StoredFile]) -> str:
    facts = [name, scene, [[file.name, file.size, file.version] for file in files]]
    return hashlib.sha256(json.dumps(facts).encode()).hexdigest()


def _safe_name(source: str) -> str:
    """The last part of a path or URL as the name of a folder."""
    name = source.rstrip("/").rpartition("/")[2]
    for suffix in (".mcap", ".db3"):
        name = name.removesuffix(suffix)
    return re.sub(r"[^\w.+-]", "_", name).lstrip(".")[:LONGEST_NAME] or "drive"


def _without_copies(drives: list[Drive]) -> tuple[list[Drive], tuple[str, ...]]:
    """Each input once; an input that cannot be listed is known by its source."""
    kept: dict[str, Drive] = {}
    notes = []
    for drive in drives:
        first = kept.setdefault(drive.input_hash or drive.source, drive)
        if first is not drive:
            notes.append(f"{drive.source}: is a copy of {first.source}: run once")
    if len(notes) > 3:
        notes = [*notes[:3], f"{len(notes) - 3} more copies are run once"]
    return list(kept.values()), tuple(notes)
