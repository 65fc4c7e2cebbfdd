"""The drives of a batch: from arguments and lists to single drives, each with a hash of its input.

Every scene of a nuScenes root in an object store needs the tables of its version, so each machine keeps one copy of
them, in $XDG_CACHE_HOME/bevcli/nuscenes-tables (default ~/.cache). Images are copied scene by scene.
"""

import hashlib
import json
import os
import re
import shutil
import uuid
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

from bevcli.errors import BevcliError, InputError
from bevcli.parsing.files import MIB, read_text
from bevcli.sequences.format import drives_in, is_drive
from bevcli.sequences.nuscenes.format import NuScenesOptions, is_nuscenes_root
from bevcli.sequences.nuscenes.index import choose_version, chosen_scenes, keyframes, sweep_frames, tables_of
from bevcli.sequences.nuscenes.tables import open_index
from bevcli.user_folders import user_cache
from bevcli.workshop.batch.storage import RemoteFolder, Storage, StoredFile, expand, is_url, open_storage

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
        key = hashlib.sha256(os.fsencode(f"{self.input_hash or self.source} {job_hash}")).hexdigest()
        return f"{self.name}-{key[:_KEY_DIGITS]}"


def read_list(path: Path) -> list[str]:
    """The drives in a text file: one path, URL or pattern per line; "#" starts a comment. Raises InputError."""
    lines = (line.strip() for line in read_text(path, 256 * MIB).splitlines())
    found = [line for line in lines if line and not line.startswith("#")]
    if not found:
        raise InputError(f"{path}: contains no drive (expected one path or URL per line)")
    return found


def find_drives(
    texts: Sequence[str], options: NuScenesOptions = NuScenesOptions()
) -> tuple[list[Drive], tuple[str, ...]]:
    """All drives of arguments in order, each input once, and notes for the user.

    A drive whose input cannot be listed has its `problem`.

    Args:
        texts: paths, URLs and glob patterns. A nuScenes root gives one drive per scene; a folder of drives, such as
            the root of another data set, gives all of them.
        options: the part of a nuScenes root.

    Raises InputError where a pattern matches nothing, or there are no drives.
    """
    sources = dict.fromkeys(source.rstrip("/") or source for text in texts for source in expand(text))
    with ThreadPoolExecutor(LISTING_THREADS) as pool:
        drives = [drive for found in pool.map(lambda s: list(_drives_of(s, options)), sources) for drive in found]
    if not drives:
        raise InputError("there are no drives (expected paths, URLs or patterns, or `listed=FILE`)")
    return _without_copies(drives)


def _drives_of(source: str, options: NuScenesOptions, name: str = "") -> Iterator[Drive]:
    """The drives of a path or URL. name: of a drive that is one of several in a folder; "" for the path's own."""
    path = source if is_url(source) else str(Path(source.removeprefix("file://")).absolute())
    drive = Drive(path, _safe_name(name or path))
    try:
        storage = open_storage(path)
        if _versions_at(storage) if is_url(path) else is_nuscenes_root(Path(path)):
            yield from _scenes(drive, options)
        elif not is_url(path) and not is_drive(Path(path)) and (inside := drives_in(Path(path))):
            for name, one in inside.items():
                yield from _drives_of(str(one), options, name.replace("/", "-"))
        else:
            yield replace(drive, input_hash=_hash(drive.name, None, storage.files()))
    except BevcliError as error:
        yield replace(drive, problem=str(error))


def _scenes(root: Drive, options: NuScenesOptions) -> Iterator[Drive]:
    """A drive per scene. Of the input, the tables count."""
    if is_url(root.source):
        tables, files = _copy_tables(root.source, options.version)
    else:
        tables = tables_of(Path(root.source), options.version)
        files = open_storage(str(tables)).files()
    index, _ = open_index(tables)
    for number in chosen_scenes(index, tables, options.split):
        scene = str(index.scenes.names[number])
        yield Drive(root.source, _safe_name(scene), scene, _hash(tables.name, scene, files))


def _hash(name: str, scene: str | None, files: list[StoredFile]) -> str:
    return hashlib.sha256(json.dumps([name, scene, files]).encode()).hexdigest()


def _safe_name(source: str) -> str:
    """The last part of a path or URL as the name of a folder."""
    name = source.rstrip("/").rpartition("/")[2].removesuffix(".mcap").removesuffix(".db3")
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


def _versions_at(storage: Storage) -> list[str]:
    """The names of the nuScenes versions in a folder, such as "v1.0-mini"; empty if it is no root."""
    folders = sorted(name for name in storage.names("") if name.startswith("v1."))
    return [name for name in folders if "scene.json" in storage.names(name)]


def _copy_tables(url: str, version: str | None) -> tuple[Path, list[StoredFile]]:
    """A local copy of a version's tables, and the files that it was made from. It is copied anew if one has changed.

    Raises InputError if the version is missing, or the choice is not unique.
    """
    chosen = choose_version(url, _versions_at(RemoteFolder(url)), version)
    storage = RemoteFolder(f"{url}/{chosen}")
    files = storage.files()
    facts = repr((url, [tuple(file) for file in files]))
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


def fetch_scene(url: str, options: NuScenesOptions, name: str, local: Path) -> None:
    """Make a local root with one scene: its tables, images, and CAN bus data if there are any. Raises InputError.

    name: of the scene. An image that is missing in the store is missing in the local root too.
    """
    tables, _ = _copy_tables(url, options.version)
    index, _ = open_index(tables)
    (scene,) = chosen_scenes(index, tables, None, name)
    frames = sweep_frames(index, scene) if options.sweeps else keyframes(index, scene)
    images = {index.images.files[row].decode() for _, _, rows in frames for row in rows}
    local.mkdir(parents=True)
    (local / tables.name).symlink_to(tables)
    RemoteFolder(url).fetch(local, sorted(images | {f"can_bus/{name}_pose.json"}))
