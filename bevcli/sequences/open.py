"""`open_sequence`: recognises the format of an input and opens it as a Sequence.

To add a format, write a package beside `native` and `nuscenes`, and add an entry to FORMATS.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from bevcli.errors import InputError
from bevcli.frame import Sequence
from bevcli.geometry.cameras import CameraRig
from bevcli.sequences.files.calibration_file import read_calibration
from bevcli.sequences.files.kalibr_ros import read_rig
from bevcli.sequences.native.folder import EgoMotionUse, FolderSequence, is_native_folder
from bevcli.sequences.native.ground_truth import GroundTruthUse
from bevcli.sequences.nuscenes.choice import NuScenesChoice, is_nuscenes_root
from bevcli.sequences.nuscenes.sequence import NuScenesSequence
from bevcli.sequences.ros.bag import is_ros_bag
from bevcli.sequences.ros.topics_file import read_topics_file
from bevcli.sequences.selection import WithoutGroundTruth, select_every, select_range, select_rate, select_scene


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
    calibration: Path | None
    ego_motion_file: Path | None
    topics_file: Path | None
    topics: Mapping[str, str]
    ground_truth: GroundTruthUse


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
    calibration: str | Path | None = None,
    ego_motion_file: str | Path | None = None,
    ground_truth: bool = True,
    class_map: Mapping[str, str] | None = None,
    topics: Mapping[str, str] | None = None,
    topics_file: str | Path | None = None,
) -> Sequence:
    """Open a drive: a native sequence folder (images or videos), a nuScenes dataset root, an MCAP file or a ROS 2 bag.

        drive = open_sequence("my_drive")
        drive = open_sequence("drive.mcap", calibration="calibration.json")
        drive = open_sequence("my_drive", rate_hz=2.0, frames=slice(0, 40))
        drive = open_sequence("nuscenes", version="v1.0-mini", scene="scene-0103")
        for place, stamp in enumerate(drive.stamps):
            frame = drive.load(place)

    Only calibration, times and poses are read here. `load` decodes the images of a frame.

    Args:
        path: the folder or file.
        frames: only frames in this range of positions, after thinning. None: all.
        rate_hz: thin to about this many frames per second, see `select_rate`. None: keep the input's rate.
        every: keep every N-th frame of each scene; excludes `rate_hz`.
        ego_motion: use of the ego-motion of a native folder or a bag. "required": it must exist. "optional": without
            it, boxes are in the ego frame only. "static": the vehicle stands and the ego-motion is not read.
        strict: a missing or unreadable image is an error, not a gap.
        scene: only frames of this scene.
        version: nuScenes: the version's folder, such as "v1.0-mini". None: the only one.
        split: nuScenes: only scenes of this official split.
        sweeps: nuScenes: also the images between the keyframes.
        intrinsics: native folder: Kalibr or ROS intrinsics that, with `extrinsics`, replace calibration.json.
        extrinsics: native folder: JSON with the cameras' poses, see `kalibr_ros.read_rig`.
        calibration: a calibration.json that replaces the input's calibration. Not for nuScenes.
        ego_motion_file: an ego_motion.csv that replaces the input's ego-motion. Not for nuScenes.
        ground_truth: whether ground truth is read.
        class_map: native folder: class names in its ground truth -> the ten classes, such as {"Lorry": "truck"}.
        topics: bag: camera -> its image topic, where it is not found. Such a camera gets this name.
        topics_file: bag: TOML with topics and frames, see `bevcli.sequences.ros.topics_file`.

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
    options = _Options(
        ego_motion,
        strict,
        scene,
        version,
        split,
        sweeps,
        intrinsics=_path(intrinsics),
        extrinsics=_path(extrinsics),
        calibration=_path(calibration),
        ego_motion_file=_path(ego_motion_file),
        topics_file=_path(topics_file),
        topics=topics or {},
        ground_truth=GroundTruthUse(ground_truth, class_map or {}),
    )
    opener = _opener_of(path)
    if opener is not _open_bag and (options.topics or options.topics_file):
        raise InputError(f"{path}: --topic and --topics are for MCAP files and ROS bags: remove them")
    sequence = opener(path, options)
    if every is not None:
        sequence = select_every(sequence, every)
    if rate_hz is not None:
        sequence = select_rate(sequence, rate_hz)
    return sequence if frames is None else select_range(sequence, frames)


def _path(file: str | Path | None) -> Path | None:
    return None if file is None else Path(file)


def _open_nuscenes(path: Path, options: _Options) -> Sequence:
    if options.intrinsics or options.extrinsics:
        raise InputError(f"{path}: a nuScenes root has its own calibration: remove --intrinsics and --extrinsics")
    if options.calibration:
        raise InputError(f"{path}: a nuScenes root has its own calibration: remove --calibration")
    if options.ego_motion == "static" or options.ego_motion_file:
        given = "--static" if options.ego_motion == "static" else "--ego-motion"
        raise InputError(f"{path}: a nuScenes root has its own ego-motion: remove {given}")
    choice = NuScenesChoice(options.version, options.scene, options.split, options.sweeps)
    sequence = NuScenesSequence(path, choice, strict=options.strict)
    return sequence if options.ground_truth.is_read else WithoutGroundTruth(sequence)


def _open_native_folder(path: Path, options: _Options) -> Sequence:
    if options.version or options.split or options.sweeps:
        raise InputError(
            f"{path}: --version, --split and --sweeps are for nuScenes roots (found no v1.0-* folder): remove them"
        )
    sequence = FolderSequence(
        path,
        ego_motion=options.ego_motion,
        strict=options.strict,
        rig=_stated_rig(options),
        ego_motion_file=options.ego_motion_file,
        ground_truth=options.ground_truth,
    )
    return sequence if options.scene is None else select_scene(sequence, options.scene)


def _open_bag(path: Path, options: _Options) -> Sequence:
    from bevcli.sequences.ros.sequence import RosSequence  # its packages are an extra

    if options.version or options.split or options.sweeps or options.scene:
        raise InputError(f"{path}: --scene, --version, --split and --sweeps are not for ROS bags: remove them")
    return RosSequence(
        path,
        ego_motion=options.ego_motion,
        strict=options.strict,
        stated=read_topics_file(options.topics_file, options.topics),
        rig=_stated_rig(options),
        ego_motion_file=options.ego_motion_file,
    )


def _stated_rig(options: _Options) -> CameraRig | None:
    """The rig of --calibration or of --intrinsics and --extrinsics, None if none of them is given."""
    if options.calibration is None:
        return read_rig(options.intrinsics, options.extrinsics)
    if options.intrinsics or options.extrinsics:
        raise InputError("--calibration excludes --intrinsics and --extrinsics: pass one of them")
    return read_calibration(options.calibration)


# The formats: whether a path has it, and what opens it. The first match is taken.
FORMATS: tuple[tuple[Callable[[Path], bool], Callable[[Path, _Options], Sequence]], ...] = (
    (is_nuscenes_root, _open_nuscenes),
    (is_ros_bag, _open_bag),
    (is_native_folder, _open_native_folder),
)


def _opener_of(path: Path) -> Callable[[Path, _Options], Sequence]:
    if not path.exists():
        raise InputError(f"{path}: is missing (expected a sequence folder, a nuScenes root, or a ROS bag)")
    if path.suffix == ".bag":
        raise InputError(f"{path}: is a bag of ROS 1: convert it (rosbags-convert --src {path.name} --dst {path.stem})")
    if not path.is_dir() and not is_ros_bag(path):
        raise InputError(f"{path}: is a file (expected a sequence folder, a nuScenes root, or an .mcap or .db3 file)")
    for has_format, opener in FORMATS:
        if has_format(path):
            return opener
    raise InputError(
        f"{path}: is not a sequence folder (expected calibration.json, frames.csv, ego_motion.csv, images or videos) "
        "and not a nuScenes root (expected v1.0-*/scene.json) or a ROS bag (expected .mcap or .db3 files)"
    )
