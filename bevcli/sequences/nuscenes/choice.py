"""Which part of a nuScenes dataset is read: version, official split and scenes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bevcli.errors import InputError
from bevcli.sequences.nuscenes.index import NuScenesIndex

# Scene numbers of the official splits, as published on nuscenes.org. All other scenes are in train and mini_train.
VAL = (
    "3 12-18 35-36 38-39 92-110 221 268-278 329-332 344-346 519-524 552-565 625-627 629-630 632-638 770-771 775 "
    "777-778 780-784 794-800 802 904-917 919-931 962-963 966-969 971-972 1059-1073"
)
TEST = (
    "77-91 111-119 140 142-148 265-266 279-282 307-314 333-343 481-498 547-551 601-604 606-624 827-831 833-842 "
    "844-846 932-933 935-943 1026-1043"
)
MINI_VAL = "103 916"
SPLITS = ("train", "val", "test", "mini_train", "mini_val")


@dataclass(frozen=True)
class NuScenesChoice:
    """The part of a dataset to read.

    Attributes:
        version: name of the version's folder, such as "v1.0-mini". None: the only version in the root.
        scene: name of a scene, such as "scene-0103". None: all scenes.
        split: one of SPLITS. None: all scenes.
        sweeps: whether to read the images between the keyframes too.
    """

    version: str | None = None
    scene: str | None = None
    split: str | None = None
    sweeps: bool = False


def is_nuscenes_root(path: Path) -> bool:
    """Whether a folder contains the tables of a nuScenes version, such as ROOT/v1.0-mini/scene.json."""
    return bool(_versions(path))


def tables_of(root: Path, version: str | None) -> Path:
    """The folder with a version's tables. Raises InputError if it is missing, or if the choice is not unique."""
    return root / choose_version(root, _versions(root), version)


def choose_version(root: object, versions: Sequence[str], version: str | None) -> str:
    """The version with a name, or the only one. root: for messages. Raises InputError as `tables_of`."""
    if version is None and len(versions) == 1:
        return versions[0]
    if version is not None and version in versions:
        return version
    found = ", ".join(versions) or "none"
    wanted = f'has no version "{version}"' if version else "has several versions"
    raise InputError(f"{root}: {wanted} (found: {found}): choose one with --version")


def chosen_scenes(index: NuScenesIndex, tables: Path, choice: NuScenesChoice) -> list[int]:
    """Indices of the chosen scenes. Raises InputError if there are none, or for an unknown scene or split."""
    names = [str(name) for name in index.scenes.names]
    if choice.split is not None and choice.split not in SPLITS:
        raise InputError(f'--split "{choice.split}": expected one of {", ".join(SPLITS)}')
    if choice.scene is not None and choice.scene not in names:
        few = ", ".join(names[:6]) + (f", ... ({len(names)} scenes)" if len(names) > 6 else "")
        raise InputError(f'{tables}: has no scene "{choice.scene}" (found: {few})')
    mini = (choice.split or "").startswith("mini")
    scenes = [
        number
        for number, name in enumerate(names)
        if choice.scene in (None, name) and choice.split in (None, split_of(name, mini=mini))
    ]
    if not scenes:
        what = f"scene {choice.scene} is not in" if choice.scene else "has no scene of"
        raise InputError(f"{tables}: {what} the split {choice.split}: choose another --split or --version")
    return scenes


def split_of(scene: str, *, mini: bool) -> str:
    """The split of a scene such as "scene-0103"; "" for a name that does not belong to nuScenes.

    mini: whether to name the split of the mini version (mini_train, mini_val) instead of train, val or test.
    """
    number = scene.removeprefix("scene-")
    if not (number.isascii() and number.isdigit() and len(number) < 10):
        return ""
    if mini:
        return "mini_val" if int(number) in numbers(MINI_VAL) else "mini_train"
    if int(number) in numbers(VAL):
        return "val"
    return "test" if int(number) in numbers(TEST) else "train"


def numbers(ranges: str) -> frozenset[int]:
    """The numbers in ranges such as "3 12-18"."""
    found: set[int] = set()
    for part in ranges.split():
        first, _, last = part.partition("-")
        found |= set(range(int(first), int(last or first) + 1))
    return frozenset(found)


def _versions(root: Path) -> list[str]:
    return sorted(path.parent.name for path in root.glob("v1.*/scene.json"))
