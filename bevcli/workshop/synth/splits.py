"""Splits: the drives to train on, and those to score on. A file states them, or the last drives are held out."""

import glob
import hashlib
import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from bevcli.errors import InputError
from bevcli.geometry.cameras import CameraRig
from bevcli.model.config import ModelConfig
from bevcli.parsing.documents import TOML_BYTES, parse_toml
from bevcli.parsing.files import read_text
from bevcli.workshop.synth.drives import Drives, FolderDrives, open_drives, split_drives
from bevcli.workshop.synth.options import DriveOptions
from bevcli.workshop.synth.rig import RigDistribution
from bevcli.writing import write_whole

KEYS = ("train", "validate")
DRAWN_KEYS = ("drives", "validate_share", "seed")  # of a file whose drives are drawn


@dataclass(frozen=True)
class Split:
    """The sequence folders of a split file.

    Attributes:
        train: to train on.
        validate: to score on, none of which is trained on.
    """

    train: tuple[Path, ...]
    validate: tuple[Path, ...]


def read_split(path: Path) -> Split:
    """The drives in a TOML file with the keys train and validate, or with drives that are drawn by a seed.

        train = ["drives/2024-*"]
        validate = ["drives/2025-01", "drives/2025-02"]

        drives = ["drives/*"]
        validate_share = 0.2
        seed = 0

    Folders are relative to the file; *, ? and [abc] stand for the folders that match, in the order of their names.
    Raises InputError for another key, a list that leaves no drive, or a drive that is missing or stands there twice.
    """
    table = parse_toml(read_text(path, TOML_BYTES), path)
    if set(table) == set(DRAWN_KEYS):
        split = _drawn(path, **table)
    elif set(table) == set(KEYS):
        split = Split(*(_folders(path, key, table[key]) for key in KEYS))
    else:
        either = f"{' and '.join(KEYS)}, or {', '.join(DRAWN_KEYS)}"
        raise InputError(f"{path}: expected the keys {either}, found {', '.join(table) or 'none'}")
    times = Counter(folder.resolve() for folder in (*split.train, *split.validate))
    twice = [str(folder) for folder, count in times.items() if count > 1]
    if twice:
        raise InputError(f"{path}: {twice[0]} stands there twice: a drive is trained on or scored on, once")
    return split


def split_of(data: DriveOptions, held_out: int) -> Split | None:
    """The folders to train on and to score on; None for rendered drives. Raises InputError as `read_split`."""
    if data.split is not None:
        return _only_split(data, data.split)
    first = len(data.data) - held_out
    return Split(data.data[:first], data.data[first:]) if data.rendered is None else None


def write_split(path: Path, split: Split) -> None:
    """Write a split file with absolute paths. Raises OutputError."""
    for_glob = {key: [glob.escape(str(folder.resolve())) for folder in getattr(split, key)] for key in KEYS}
    text = "".join(f"{key} = {json.dumps(folders, ensure_ascii=False)}\n" for key, folders in for_glob.items())
    write_whole(path, text.encode())


def training_drives(
    data: DriveOptions, held_out: int, cache: Path, config: ModelConfig, rigs: RigDistribution | None
) -> tuple[Drives, Drives]:
    """The drives to train on, and those to score on: of the split file, or else the last `held_out`.

    Raises InputError as `read_split` and `split_drives`.
    """
    if data.split is None:
        drives = open_drives(data.data, data.rendered, cache, config, rigs, data.class_map)
        return split_drives(drives, held_out)
    split = _only_split(data, data.split)
    train, validate = (FolderDrives(folders, config, data.class_map) for folders in (split.train, split.validate))
    return train, validate


def scored_drives(data: DriveOptions, config: ModelConfig, rig: CameraRig | RigDistribution | None = None) -> Drives:
    """The drives to score on. rig: of rendered ones, as for `open_drives`. Raises InputError as `read_split`."""
    if data.split is None:
        return open_drives(data.data, data.rendered, data.cache, config, rig, data.class_map)
    return FolderDrives(_only_split(data, data.split).validate, config, data.class_map)


def _only_split(data: DriveOptions, path: Path) -> Split:
    if data.data or data.rendered is not None:
        raise InputError(f"{path}: states the drives: remove `{'data' if data.data else 'rendered'}`, or `split`")
    return read_split(path)


def _drawn(path: Path, drives: object, validate_share: object, seed: object) -> Split:
    """The split that follows from a seed and the names of the drives, whatever their order. Raises InputError."""
    folders = _folders(path, "drives", drives)
    if not isinstance(validate_share, float) or not 0 < validate_share < 1:
        raise InputError(f"{path}: validate_share: expected a number between 0 and 1, found {validate_share!r:.40}")
    if not isinstance(seed, int):
        raise InputError(f"{path}: seed: expected an integer, found {seed!r:.40}")
    if len(folders) < 2:
        raise InputError(f"{path}: drives: leaves no drive to score on (expected at least two folders)")
    drawn = sorted(folders, key=lambda folder: hashlib.sha256(f"{seed} {folder.name}".encode()).digest())
    count = min(max(1, round(validate_share * len(folders))), len(folders) - 1)
    validate = set(drawn[:count])
    return Split(*(tuple(each for each in folders if (each in validate) == chosen) for chosen in (False, True)))


def _folders(path: Path, key: str, names: object) -> tuple[Path, ...]:
    """The folders of a list. Raises InputError."""
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise InputError(f'{path}: {key}: expected a list of folders, such as ["drives/a"], found {names!r:.60}')
    folders: list[Path] = []
    for name in names:
        found = sorted(glob.glob(str(path.parent / name))) if set(name) & set("*?[") else [str(path.parent / name)]
        missing = [each for each in found if not Path(each).exists()]
        if missing or not found:
            raise InputError(f"{path}: {key}: {name}: there is no such folder")
        folders += map(Path, found)
    if not folders:
        raise InputError(f"{path}: {key}: leaves no drive (expected at least one folder)")
    return tuple(folders)
