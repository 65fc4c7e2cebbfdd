"""`open_sequence`: recognises the format of an input and opens it as a Sequence.

To add a format, write a package beside `native` and `nuscenes`, and add an entry to FORMATS.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from bevcli.errors import InputError
from bevcli.frame import Sequence
from bevcli.sequences.files.kalibr_ros import read_rig
from bevcli.sequences.native.folder import EgoMotionUse, FolderSequence, is_native_folder
from bevcli.sequences.nuscenes.choice import NuScenesChoice, is_nuscenes_root
from bevcli.sequences.nuscenes.sequence import NuScenesSequence
from bevcli.sequences.selection import select_every, select_range, select_rate, select_scene


@dataclass(frozen=True)
class _Options:
    """The options of `open_sequence` that the readers of the formats take."""

    ego_motion: EgoMotionUse
    strict: bool
    scene: str | None
    version: str | None
    split: str | None
    sweeps: bool
    intrinsics: Path | None
    extrinsics: Path | None
    allow_outside: bool


def open_sequence(
    path: str | Path,
    *,
    frames: slice | None = None,
    rate_hz: float | None = None,
    every: int | None = None,
    ego_motion: EgoMotionUse = "required",
    strict: bool = False,
    scene: str | None = None,
    version: str | None = None,
    split: str | None = None,
    sweeps: bool = False,
    intrinsics: str | Path | None = None,
    extrinsics: str | Path | None = None,
    allow_outside: bool = False,
) -> Sequence:
    """Open a drive: a native sequence folder (with images or videos) or a nuScenes dataset root.

        drive = open_sequence("my_drive")
        drive = open_sequence("my_drive", rate_hz=2.0, frames=slice(0, 40))
        drive = open_sequence("nuscenes", version="v1.0-mini", scene="scene-0103")
        for place, stamp in enumerate(drive.stamps):
            frame = drive.load(place)

    Only calibration, times and poses are read here. `load` decodes the images of a frame.

    Args:
        path: the folder.
        frames: only frames in this range of positions, after thinning. None: all.
        rate_hz: thin to about this many frames per second, see `select_rate`. None: keep the input's rate.
        every: keep every N-th frame of each scene; excludes `rate_hz`.
        ego_motion: use of a native folder's ego_motion.csv. "required": it must exist. "optional": without it, boxes
            are in the ego frame only. "static": the vehicle stands and the file is not read.
        strict: a missing or unreadable image is an error, not a gap.
        scene: only frames of this scene.
        version: nuScenes: the version's folder, such as "v1.0-mini". None: the only one.
        split: nuScenes: only scenes of this official split.
        sweeps: nuScenes: also the images between the keyframes.
        intrinsics: native folder: Kalibr or ROS intrinsics that, with `extrinsics`, replace calibration.json.
        extrinsics: native folder: JSON with the cameras' poses, see `kalibr_ros.read_rig`.
        allow_outside: read images outside of the folder too: absolute paths, "..", and links that lead out of it.

    Raises InputError if the folder has no known format, a file in it is missing or invalid, an option does not apply
    to the format, or no frame is left. Its messages name the options as the command line does, such as --scene.
    """
    path = Path(path)
    if rate_hz is not None and every is not None:
        raise InputError("--rate and --every exclude each other: pass one of them")
    if rate_hz is not None and not 0 < rate_hz < float("inf"):
        raise InputError(f"--rate {rate_hz:g}: expected frames per second, above 0")
    if every is not None and every < 1:
        raise InputError(f"--every {every}: expected an integer, 1 or more")
    yaml, poses = (None if file is None else Path(file) for file in (intrinsics, extrinsics))
    options = _Options(ego_motion, strict, scene, version, split, sweeps, yaml, poses, allow_outside)
    sequence = _opener_of(path)(path, options)
    if every is not None:
        sequence = select_every(sequence, every)
    if rate_hz is not None:
        sequence = select_rate(sequence, rate_hz)
    return sequence if frames is None else select_range(sequence, frames)


def _open_nuscenes(path: Path, options: _Options) -> Sequence:
    if options.intrinsics or options.extrinsics:
        raise InputError(f"{path}: a nuScenes root has its own calibration: remove --intrinsics and --extrinsics")
    if options.ego_motion == "static":
        raise InputError(f"{path}: a nuScenes root has its own ego-motion: remove --static")
    choice = NuScenesChoice(options.version, options.scene, options.split, options.sweeps)
    return NuScenesSequence(path, choice, strict=options.strict, allow_outside=options.allow_outside)


def _open_native_folder(path: Path, options: _Options) -> Sequence:
    if options.version or options.split or options.sweeps:
        raise InputError(
            f"{path}: --version, --split and --sweeps are for nuScenes roots (found no v1.0-* folder): remove them"
        )
    rig = read_rig(options.intrinsics, options.extrinsics)
    sequence = FolderSequence(
        path, ego_motion=options.ego_motion, strict=options.strict, rig=rig, allow_outside=options.allow_outside
    )
    return sequence if options.scene is None else select_scene(sequence, options.scene)


# The formats: whether a folder has it, and what opens it. The first match is taken.
FORMATS: tuple[tuple[Callable[[Path], bool], Callable[[Path, _Options], Sequence]], ...] = (
    (is_nuscenes_root, _open_nuscenes),
    (is_native_folder, _open_native_folder),
)


def _opener_of(path: Path) -> Callable[[Path, _Options], Sequence]:
    if not path.exists():
        raise InputError(f"{path}: the folder is missing (expected a sequence folder or a nuScenes root)")
    if not path.is_dir():
        raise InputError(f"{path}: is a file (expected a sequence folder or a nuScenes root)")
    for has_format, opener in FORMATS:
        if has_format(path):
            return opener
    raise InputError(
        f"{path}: is not a sequence folder (expected calibration.json, frames.csv, ego_motion.csv, images or videos) "
        "and not a nuScenes root (expected v1.0-*/scene.json)"
    )
