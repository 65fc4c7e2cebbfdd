"""`open_sequence`: finds out what it was given, and gives back a Sequence."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from bevcli.errors import InputError
from bevcli.frame import Sequence
from bevcli.sequences.folder import EgoMotionUse, FolderSequence
from bevcli.sequences.selection import select

PARTS_OF_A_FOLDER = ("calibration.json", "frames.csv", "ego_motion.csv", "images", "videos")


@dataclass(frozen=True)
class InputOptions:
    """What a user may say about an input beside its path.

    ego_motion: "required"; "static": the vehicle stands; "none": a missing file is allowed.
    strict: a missing or unreadable picture is an error. scene: only frames of this one.
    """

    ego_motion: EgoMotionUse = "required"
    strict: bool = False
    scene: str | None = None


def open_sequence(path: Path, options: InputOptions = InputOptions()) -> Sequence:
    """The sequence in a native folder.

    Raises InputError where the path holds nothing of the kind, or something in it is wrong.
    """
    if not path.exists():
        raise InputError(f"{path}: there is no such folder")
    if not path.is_dir():
        raise InputError(f"{path}: is a file (expected a sequence folder with calibration.json and pictures)")
    if not any((path / part).exists() for part in PARTS_OF_A_FOLDER):
        raise InputError(f"{path}: is no sequence folder (none of {', '.join(PARTS_OF_A_FOLDER)} is in it)")
    sequence = FolderSequence(path, ego_motion=options.ego_motion, strict=options.strict)
    return sequence if options.scene is None else _scene(sequence, path, options.scene)


def _scene(sequence: Sequence, path: Path, scene: str) -> Sequence:
    places = [place for place, stamp in enumerate(sequence.stamps) if stamp.scene == scene]
    if not places:
        names = sorted({stamp.scene for stamp in sequence.stamps} - {""})
        found = ", ".join(names[:8]) + (", ..." if len(names) > 8 else "") if names else "no scenes"
        raise InputError(f'{path}: has no scene "{scene}" (found {found})')
    return select(sequence, places)
