"""nuScenes roots in object stores.

Every scene needs the tables of its version, so each machine keeps one copy of them, in
$XDG_CACHE_HOME/bevcli/nuscenes-tables (default ~/.cache). Images are copied scene by scene.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import uuid
from pathlib import Path

from bevcli.batch.storage import Storage, StoredFile, open_storage
from bevcli.errors import InputError
from bevcli.sequences.nuscenes.cache import open_index, user_cache
from bevcli.sequences.nuscenes.choice import NuScenesChoice, choose_version, chosen_scenes
from bevcli.sequences.nuscenes.frames import keyframes, sweep_frames


def versions_at(storage: Storage) -> list[str]:
    """The names of the nuScenes versions in a folder, such as "v1.0-mini"; empty if it is no root."""
    folders = sorted(name for name in storage.names("") if name.startswith("v1."))
    return [name for name in folders if "scene.json" in storage.names(name)]


def copy_tables(url: str, version: str | None) -> tuple[Path, list[StoredFile]]:
    """A local copy of a version's tables, and the files that it was made from. It is copied anew if one has changed.

    Raises InputError if the version is missing, or the choice is not unique.
    """
    chosen = choose_version(url, versions_at(open_storage(url)), version)
    storage = open_storage(f"{url}/{chosen}")
    files = storage.files()
    facts = repr((url, [(file.name, file.size, file.version) for file in files]))
    tables = user_cache() / "nuscenes-tables" / hashlib.sha256(facts.encode()).hexdigest()[:16] / chosen
    if not tables.is_dir():
        unfinished = tables.parent / f"{uuid.uuid4().hex[:8]}.new"
        try:
            storage.fetch(unfinished)
            os.rename(unfinished, tables)
        except OSError as error:
            if not tables.is_dir():  # else another worker was faster
                raise InputError(f"{tables}: the tables cannot be copied there ({error.strerror})") from None
        finally:
            shutil.rmtree(unfinished, ignore_errors=True)
    return tables, files


def fetch_scene(url: str, choice: NuScenesChoice, local: Path) -> None:
    """Makes a local root with one scene: its tables, images, and CAN bus data if there are any. Raises InputError.

    choice: with a scene. An image that is missing in the store is missing in the local root too.
    """
    tables, _ = copy_tables(url, choice.version)
    index, _ = open_index(tables)
    (scene,) = chosen_scenes(index, tables, choice)
    frames = sweep_frames(index, scene) if choice.sweeps else keyframes(index, scene)
    images = {index.images.files[row].decode() for _, _, rows in frames for row in rows}
    local.mkdir(parents=True)
    (local / tables.name).symlink_to(tables)
    open_storage(url).fetch(local, sorted(images | {f"can_bus/{choice.scene}_pose.json"}))
