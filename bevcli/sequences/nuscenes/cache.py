"""Cache for the index of a large nuScenes version: memory-mapped arrays that open almost at once.

The cache is in $XDG_CACHE_HOME/bevcli/nuscenes (default ~/.cache/bevcli/nuscenes), never in the dataset, with one
folder for each version's path. The index is rebuilt if the size or modification time of a table has changed, or a file
of the cache is missing or damaged. Small versions are not cached.
"""

import hashlib
import json
import os
import shutil
from contextlib import suppress
from dataclasses import fields
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np

from bevcli.sequences.nuscenes.build import build_index
from bevcli.sequences.nuscenes.index import NUSCENES, Dialect, NuScenesIndex
from bevcli.user_folders import user_cache

FORMAT = 2  # version of the cached arrays; increase it when the index changes
SMALLEST_BYTES = 64 << 20  # smaller tables are not cached, because reading them takes a second or two
FINGERPRINT = "fingerprint.json"


def open_index(tables: Path, dialect: Dialect = NUSCENES) -> tuple[NuScenesIndex, str]:
    """The index of a folder with tables, from the cache if it is up to date, and a note for the user or ""."""
    if sum(path.stat().st_size for path in tables.glob("*.json")) < SMALLEST_BYTES:
        return build_index(tables, dialect), ""
    name = hashlib.sha256(str(tables.resolve()).encode()).hexdigest()[:16]
    folder = user_cache() / "nuscenes" / f"{tables.name}-{name}"
    facts = [(path.name, path.stat().st_size, path.stat().st_mtime_ns) for path in sorted(tables.glob("*.json"))]
    fingerprint = json.dumps({"format": FORMAT, "tables": facts})
    with suppress(OSError, ValueError, EOFError):  # there is no cache, or it is damaged
        if (folder / FINGERPRINT).read_text() == fingerprint:
            return _load(folder), ""
    index = build_index(tables, dialect)
    try:
        _save(index, folder, fingerprint)
    except OSError as error:
        return index, f"{folder}: the index cannot be cached ({error.strerror}); opening it again will be slow"
    return index, f"the index of the nuScenes tables is cached in {folder}"


def _save(index: NuScenesIndex, folder: Path, fingerprint: str) -> None:
    """Write to a temporary folder, then rename it, so that an interrupted run leaves no incomplete index."""
    unfinished = folder.with_name(f"{folder.name}.{os.getpid()}")
    shutil.rmtree(unfinished, ignore_errors=True)
    unfinished.mkdir(parents=True)
    for part, table in vars(index).items():
        for name, values in vars(table).items():
            np.save(unfinished / f"{part}.{name}.npy", values, allow_pickle=False)
    (unfinished / FINGERPRINT).write_text(fingerprint)
    shutil.rmtree(folder, ignore_errors=True)
    unfinished.rename(folder)


def _load(folder: Path) -> NuScenesIndex:
    parts: dict[str, Any] = {}
    for name, kind in get_type_hints(NuScenesIndex).items():
        columns = {
            column.name: np.load(folder / f"{name}.{column.name}.npy", mmap_mode="r", allow_pickle=False)
            for column in fields(kind)
        }
        parts[name] = kind(**columns)
    return NuScenesIndex(**parts)
