"""`open_sequence`: finds out what it was given, and gives back a Sequence."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from bevcli.errors import InputError
from bevcli.frame import Sequence
from bevcli.sequences.files.intrinsics import read_rig
from bevcli.sequences.native.folder import EgoMotionUse, FolderSequence
from bevcli.sequences.nuscenes.scenes import NuScenesChoice, NuScenesSequence, is_nuscenes_root
from bevcli.sequences.selection import select

PARTS_OF_A_FOLDER = ("calibration.json", "frames.csv", "ego_motion.csv", "images", "videos")


@dataclass(frozen=True)
class InputOptions:
    """What a user may say about an input beside its path.

    ego_motion: "required"; "static": the vehicle stands; "none": a missing file is allowed.
    strict: a missing or unreadable image is an error. scene: only frames of this one.
    version, split, sweeps: of nuScenes, see `NuScenesChoice`.
    intrinsics, extrinsics: files that replace calibration.json, see `read_rig`.
    """

    ego_motion: EgoMotionUse = "required"
    strict: bool = False
    scene: str | None = None
    version: str | None = None
    split: str | None = None
    sweeps: bool = False
    intrinsics: Path | None = None
    extrinsics: Path | None = None


def open_sequence(path: Path, options: InputOptions = InputOptions()) -> Sequence:
    """The sequence in a native folder (with images or videos) or a nuScenes dataset root.

    Raises InputError where the path holds nothing of the kind, or something in it is wrong.
    """
    if not path.exists():
        raise InputError(f"{path}: there is no such folder")
    if not path.is_dir():
        raise InputError(f"{path}: is a file (expected a sequence folder with calibration.json and images)")
    if is_nuscenes_root(path):
        return _open_nuscenes(path, options)
    if not any((path / part).exists() for part in PARTS_OF_A_FOLDER):
        expected = f"{', '.join(PARTS_OF_A_FOLDER)}, or a nuScenes root's v1.0-*/scene.json"
        raise InputError(f"{path}: is no sequence folder (it has none of {expected})")
    return _open_folder(path, options)


def _open_folder(path: Path, options: InputOptions) -> Sequence:
    if options.version or options.split or options.sweeps:
        raise InputError(f"{path}: --version, --split and --sweeps are for nuScenes roots (no v1.0-* folder is in it)")
    rig = read_rig(options.intrinsics, options.extrinsics)
    sequence = FolderSequence(path, ego_motion=options.ego_motion, strict=options.strict, rig=rig)
    return sequence if options.scene is None else _scene(sequence, path, options.scene)


def _open_nuscenes(path: Path, options: InputOptions) -> Sequence:
    if options.intrinsics or options.extrinsics:
        raise InputError(f"{path}: a nuScenes root has its own calibration: leave out --intrinsics and --extrinsics")
    if options.ego_motion == "static":
        raise InputError(f"{path}: a nuScenes root states where the vehicle was: leave out --static")
    choice = NuScenesChoice(options.version, options.scene, options.split, options.sweeps)
    return NuScenesSequence(path, choice, strict=options.strict)


def _scene(sequence: Sequence, path: Path, scene: str) -> Sequence:
    places = [place for place, stamp in enumerate(sequence.stamps) if stamp.scene == scene]
    if not places:
        names = sorted({stamp.scene for stamp in sequence.stamps} - {""})
        found = ", ".join(names[:8]) + (", ..." if len(names) > 8 else "") if names else "no scenes"
        raise InputError(f'{path}: has no scene "{scene}" (found {found})')
    return select(sequence, places)
