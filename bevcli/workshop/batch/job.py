"""The drives of a batch, each with a hash of its input; the job that each is run with; the record of one that was run.

Every scene of a nuScenes root in an object store needs the tables of its version, so each machine keeps one copy of
them, in $XDG_CACHE_HOME/bevcli/nuscenes-tables (default ~/.cache). Images are copied scene by scene.
"""

import contextlib
import hashlib
import os
import re
import shutil
import uuid
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, NotRequired, TypedDict, TypeVar

import msgspec
from msgspec import Meta

from bevcli._version import __version__
from bevcli.errors import BevcliError, InputError
from bevcli.frame import Drive
from bevcli.inference import ModelOptions
from bevcli.inference.load import Model, load_model
from bevcli.options import defaults, gather
from bevcli.parsing.files import MIB, hash_of_file, hash_of_values, read_text
from bevcli.runs import RunOptions
from bevcli.sequences.format import Format, check_options, drives_in, format_of, formats, is_drive
from bevcli.sequences.open import open_sequence
from bevcli.sequences.options import InputOptions
from bevcli.workshop.batch.storage import RemoteFolder, Storage, StoredFile, expand, is_url, open_storage
from bevcli.workshop.formats import NuScenesOptions, is_nuscenes_root
from bevcli.workshop.formats.nuscenes_index import choose_version, chosen_scenes, keyframes, sweep_frames, tables_of
from bevcli.workshop.formats.nuscenes_tables import open_index
from bevcli.writing import user_cache, weights_folder

LISTING_THREADS = 32  # listing a folder in an object store is waiting
LONGEST_NAME = 80
_KEY_DIGITS = 12


@dataclass(frozen=True)
class BatchDrive:
    """One drive of a batch."""

    source: str  # path or URL of its folder or file, or of the nuScenes root that contains it
    name: str  # short name, for the folder of its results
    scene: str | None = None  # of a nuScenes root, None for other inputs
    input_hash: str = ""  # of the name and of names, sizes and versions of the files; "" if they could not be listed
    problem: str = ""  # why it cannot be run, "" if nothing is known

    def result(self, job_hash: str) -> str:
        """The name of the folder of its results: other input, model, weights or options have another name."""
        key = hashlib.sha256(os.fsencode(f"{self.input_hash or self.source} {job_hash}")).hexdigest()
        return f"{self.name}-{key[:_KEY_DIGITS]}"


def read_list(path: Path) -> list[str]:
    """The drives in a text file: one path, URL or pattern per line; "#" starts a comment. Raises InputError."""
    lines = (line.strip() for line in read_text(path, 256 * MIB).splitlines())
    drives = [line for line in lines if line and not line.startswith("#")]
    if not drives:
        raise InputError(f"{path}: contains no drive (expected one path or URL per line)")
    return drives


def find_drives(
    texts: Iterable[str], options: NuScenesOptions = NuScenesOptions()
) -> tuple[list[BatchDrive], tuple[str, ...]]:
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
        drives = [drive for inside in pool.map(lambda s: list(_drives_of(s, options)), sources) for drive in inside]
    if not drives:
        raise InputError("there are no drives (expected paths, URLs or patterns, or `listed` (`--list FILE`))")
    return _without_copies(drives)


def _drives_of(source: str, options: NuScenesOptions, name: str = "") -> Iterator[BatchDrive]:
    """The drives of a path or URL. name: of a drive that is one of several in a folder; "" for the path's own."""
    path = source if is_url(source) else str(Path(source.removeprefix("file://")).absolute())
    drive = BatchDrive(path, _safe_name(name or path))
    try:
        storage = open_storage(path)
        if _versions_at(storage) if is_url(path) else is_nuscenes_root(Path(path)):
            yield from _scenes(drive, options)
        elif not is_url(path) and not is_drive(Path(path)) and (inside := drives_in(Path(path))):
            for name, path_inside in inside.items():
                yield from _drives_of(str(path_inside), options, name.replace("/", "-"))
        else:
            yield replace(drive, input_hash=hash_of_values([drive.name, None, storage.files()]))
    except BevcliError as error:
        yield replace(drive, problem=str(error))


def _scenes(root: BatchDrive, options: NuScenesOptions) -> Iterator[BatchDrive]:
    """A drive per scene. Of the input, the tables count."""
    if is_url(root.source):
        tables, files = _copy_tables(root.source, options.version)
    else:
        tables = tables_of(Path(root.source), options.version)
        files = open_storage(str(tables)).files()
    index, _ = open_index(tables)
    for number in chosen_scenes(index, tables, options.split):
        scene = str(index.scenes.names[number])
        yield BatchDrive(root.source, _safe_name(scene), scene, hash_of_values([tables.name, scene, files]))


def _safe_name(source: str) -> str:
    """The last part of a path or URL as the name of a folder."""
    name = source.rstrip("/").rpartition("/")[2].removesuffix(".mcap").removesuffix(".db3")
    return re.sub(r"[^\w.+-]", "_", name).lstrip(".")[:LONGEST_NAME] or "drive"


def _without_copies(drives: list[BatchDrive]) -> tuple[list[BatchDrive], tuple[str, ...]]:
    """Each input once; an input that cannot be listed is known by its source."""
    kept: dict[str, BatchDrive] = {}
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
    version_name = choose_version(url, _versions_at(RemoteFolder(url)), version)
    storage = RemoteFolder(f"{url}/{version_name}")
    files = storage.files()
    tables = user_cache() / "nuscenes-tables" / hash_of_values([url, files])[:16] / version_name
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


SCORE_BINS = 20  # of the histogram of a drive's scores, from 0 to 1
Record = dict[str, Any]  # of a drive after it was run; a row of batch.parquet
_Count = Annotated[int, Meta(ge=0, le=1 << 62)]
_Number = Annotated[float, Meta(ge=-1e12, le=1e12)]

Own = TypeVar("Own", bound=Format)


@dataclass(frozen=True)
class Job:
    """The model and the options of a batch. On a cluster, the paths in it must exist on every machine."""

    out: str  # path or URL of the batch's folder
    model: ModelOptions = field(default_factory=ModelOptions)  # options of `load_model`
    source: InputOptions = field(default_factory=InputOptions)  # of `open_sequence`; the scene is that of the drive
    own: tuple[Format, ...] = ()  # options of formats; a format that is missing has its defaults
    run: RunOptions = field(default_factory=RunOptions)  # options of `run_into_folder`
    evaluate: bool = False  # whether drives with ground truth are scored
    retries: int = 2  # further attempts after a drive has failed

    def load_model(self) -> Model:
        """The model with its weights. Raises BevcliError."""
        return load_model(options=self.model)

    def own_of(self, options_type: type[Own]) -> Own:
        """The own options of a format. options_type: their dataclass."""
        return next((options for options in self.own if type(options) is options_type), options_type())

    def open(self, path: Path, scene: str | None) -> Drive:
        """A drive, or a scene of it. Raises InputError."""
        format_options = self.own_of(format_of(path))
        return open_sequence(path, replace(self.source, scene=scene), **vars(format_options))

    def check_options(self, drives: Iterable[BatchDrive]) -> None:
        """Raise InputError for an option that no format of the drives has. One at a URL may have any format."""
        if any(is_url(drive.source) for drive in drives):
            return
        formats = set()
        for drive in drives:
            with contextlib.suppress(InputError):  # a drive that cannot be opened becomes a row with its error
                formats.add(format_of(Path(drive.source)))
        if formats:
            values = {name: value for options in self.own for name, value in vars(options).items()}
            check_options(values, formats, "the drives of the batch")

    def hash(self, model: Model) -> str:
        """SHA-256 of what the results of a drive depend on, its input excepted. model: of `load_model`, any device."""
        input_values = {
            name: _fact(value) for options in (self.source, *self.own) for name, value in vars(options).items()
        }
        fingerprint = {
            "version": __version__,
            "model": model.config_hash,
            "weights": model.weights_hash,
            "device": self.model.device,
            "precision": self.model.precision,
            "engine": (self.model.engine, _fact(self.model.calibrate_with)),
            "reading": input_values,
            "run": {name: _fact(value) for name, value in vars(self.run).items()},
            "evaluate": self.evaluate,
        }
        return hash_of_values(fingerprint)


def all_own_options(values: Mapping[str, Any]) -> tuple[Format, ...]:
    """The own options of every format, from the options of all formats by name. Relative paths become absolute."""
    absolute = {name: value.absolute() if isinstance(value, Path) else value for name, value in values.items()}
    return tuple(
        gather(kind, None, {name: absolute[name] for name in defaults(kind) if name in absolute}) for kind in formats()
    )


def with_absolute_paths(model: ModelOptions) -> ModelOptions:
    """The options for workers in other folders: they take the downloaded weights of this process, and fetch none."""
    weights, drive = (None if path is None else path.absolute() for path in (model.weights, model.calibrate_with))
    folder = weights_folder(model.weights_dir).absolute()
    return replace(model, weights=weights, calibrate_with=drive, weights_dir=folder, fetch=False)


def _fact(value: object) -> str:
    """A value as text; of a file, its contents count and not its name."""
    if isinstance(value, Path) and value.is_file():
        return hash_of_file(value)
    return repr(value)


class _Run(TypedDict):
    drive: str
    source: str
    scene: str | None
    result: str
    attempts: _Count
    error: str


class _Scores(TypedDict):
    ground_truth_boxes: _Count


class _Done(_Run):
    frames: _Count
    boxes: _Count
    boxes_by_class: dict[str, _Count]
    tracks: _Count | None
    dropped_images: _Count
    skipped_frames: _Count
    not_finite_frames: _Count
    seconds: _Number
    frames_per_second: _Number
    fetch_seconds: _Number
    output_bytes: _Count
    score_histogram: Annotated[list[_Count], Meta(min_length=SCORE_BINS, max_length=SCORE_BINS)]
    scores: dict[str, _Number | None] | None
    not_scored: str
    input_errors: NotRequired[str]


def read_record(content: bytes | None, result: str) -> Record | None:
    """A stored record, which may be damaged; None if there is none, or it is broken: its drive is then run again.

    result: name of the folder of the drive's results.
    """
    try:
        record: Record = msgspec.json.decode(content or b"")
        msgspec.convert(record, _Run if record["error"] else _Done)
        if record.get("scores"):
            msgspec.convert(record["scores"], _Scores)
    except (msgspec.MsgspecError, LookupError, TypeError, ValueError, RecursionError):
        return None
    return record if record["result"] == result else None
