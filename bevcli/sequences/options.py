"""The options of `open_sequence` that all input formats have, and those that several share."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias

from bevcli.errors import InputError
from bevcli.options import option, options, parse_pairs

if TYPE_CHECKING:
    from bevcli.model.config import ModelConfig

# required: the ego-motion must exist. optional: without it there are no poses, and boxes are in the ego frame only.
# static: the vehicle stands, and the ego-motion is not read. measured: as optional, and `odometry` replaces it.
EgoMotionUse = Literal["required", "optional", "static", "measured"]
TimeUnit = Literal["s", "ms", "us", "ns"]


def parse_frames(text: str) -> slice:
    """A frame range "A:B" with optional ends. Raises ValueError."""
    ends = text.split(":")
    if len(ends) != 2 or not all(re.fullmatch("[0-9]{0,18}", end) for end in ends):
        raise ValueError(f'"{text[:60]}" (expected A:B with integers, such as 0:10 or 5:)')
    start, stop = (int(end) if end else None for end in ends)
    return slice(start, stop)


def parse_rate(text: str) -> float | Literal["all"]:
    """A frame rate in Hz, or "all". Raises ValueError."""
    if text == "all":
        return "all"
    try:
        rate_hz = float(text)
    except ValueError:
        rate_hz = 0.0
    if not 0 < rate_hz < float("inf"):
        raise ValueError(f'"{text}" (expected frames per second, such as 2, or all)')
    return rate_hz


def parse_class_map(texts: list[str]) -> dict[str, str]:
    """A class map from texts NAME=CLASS and names of TOML files. Raises ValueError, InputError for a file."""
    from bevcli.sequences.files.boxes_file import read_class_map

    files = [text for text in texts if text.endswith(".toml") and "=" not in text]
    pairs = parse_pairs([text for text in texts if text not in files], "NAME=CLASS or FILE.toml")
    merged: dict[str, str] = {}
    for file in files:
        merged |= read_class_map(Path(file))
    return merged | pairs


@options("Input")
class ClassOptions:
    """The class names of ground truth."""

    class_map: Mapping[str, str] = option(
        default_factory=dict,
        help="Rename a class of the ground truth to one of the model's, such as Lorry=truck. Repeatable.",
        metavar="NAME=CLASS|FILE.toml",
        parse=parse_class_map,
        repeatable=True,
    )


@options("Input")
class InputOptions(ClassOptions):
    """The options of every input format: which frames, and how strictly they are read."""

    frames: slice | None = option(
        default=None, help="Frame range A:B after thinning; B is excluded.", metavar="A:B", parse=parse_frames
    )
    rate_hz: float | Literal["all"] | None = option(
        default=None,
        help="Thin to this many frames per second. Default: the model's rate; all with --sweeps.",
        flag="--rate",
        metavar="HZ|all",
        parse=parse_rate,
    )
    every: int | None = option(default=None, help="Use every N-th frame instead of a frame rate.", minimum=1)
    ego_motion: EgoMotionUse = option(
        default="required",
        help="The vehicle stands still; ego_motion.csv is not needed.",
        flag="--static",
        flag_value="static",
        mistaken="; a file of poses is `ego_motion_file` (`--ego-motion FILE`)",
    )
    odometry: bool = option(
        default=False,
        help="Measure the ego-motion from the images first, as `bevcli odometry` does, in place of that of the input.",
    )
    strict: bool = option(default=False, help="Treat a missing or unreadable image as an error.")
    scene: str | None = option(
        default=None, help="Only this scene, such as scene-0103; of a folder of drives, this drive."
    )
    ground_truth: bool = option(
        default=True, help="Read the ground truth, if any.", flag="--ground-truth/--no-ground-truth"
    )
    allow_outside: bool = option(
        default=False,
        help='Read images outside of the folder too: absolute paths, "..", and links that lead out of it.',
    )
    model_rate_hz: float | None = option(
        default=None, help="Frame rate of a model, used without --rate and --every.", hidden=True
    )
    classes: tuple[str, ...] | None = option(
        default=None, help="The classes of a model. Default: nuScenes' ten.", hidden=True
    )

    def __post_init__(self) -> None:
        if self.rate_hz is not None and self.every is not None:
            raise InputError("`rate_hz` (`--rate`) and `every` (`--every`) exclude each other: pass one of them")
        if isinstance(self.rate_hz, (int, float)) and not 0 < self.rate_hz < float("inf"):
            raise InputError(f"`rate_hz={self.rate_hz:g}` (`--rate`): expected frames per second, above 0")
        if self.odometry and self.ego_motion == "static":
            raise InputError(
                '`odometry` (`--odometry`) and `ego_motion="static"` (`--static`) exclude each other: pass one of them'
            )

    def refuse_static(self, path: Path) -> None:
        """Raise InputError for `ego_motion="static"`. path: of an input that has its own ego-motion."""
        if self.ego_motion == "static":
            raise InputError(f'{path}: has its own ego-motion: remove `ego_motion="static"` (`--static`)')

    def for_model(self, config: ModelConfig, *, temporal: bool = True) -> InputOptions:
        """The options for a run of a model: its rate and classes, and ego-motion only where history needs it."""
        use = "optional" if self.ego_motion == "required" and not temporal else self.ego_motion
        return replace(self, ego_motion=use, model_rate_hz=config.rate_hz, classes=config.classes)


def parse_by_camera(texts: list[str]) -> float | dict[str, float]:
    """A number for all cameras, or numbers CAMERA=NUMBER. Raises ValueError."""
    if len(texts) == 1 and "=" not in texts[0]:
        return _number(texts[0])
    pairs = parse_pairs(texts, "one number, or CAMERA=NUMBER for each camera")
    return {name: _number(text) for name, text in pairs.items()}


def _number(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not abs(value) < float("inf"):
        raise ValueError(f'"{text}" (expected a number, or CAMERA=NUMBER)')
    return value


RigAngles: TypeAlias = Literal[
    "wxyz", "xyzw", "vector", "radians", "degrees", "clockwise", "clockwise-radians", "unity"
]
PoseAngles: TypeAlias = Literal[
    "degrees", "radians", "compass", "compass-radians", "clockwise", "clockwise-radians", "vector", "wxyz", "xyzw"
]


@options("Input")
class RigOptions:
    """What replaces the calibration and the ego-motion of an input. A format that takes it inherits it."""

    calibration: Path | None = option(
        reads="path",
        default=None,
        help="A calibration that replaces that of the input: calibration.json, K, D and T in YAML, JSON or XML, "
        "Kalibr, ROS, OpenCV, COLMAP, nerfstudio or KITTI; or a folder of these (docs/other-inputs.md).",
        metavar="FILE|FOLDER",
    )
    intrinsics: Path | None = option(
        reads="path", default=None, help="Another name of --calibration, for a file without poses."
    )
    extrinsics: Path | None = option(
        reads="path", default=None, help="The poses of the cameras, in place of those of --calibration."
    )
    transform: Literal["ego_from_camera", "camera_from_ego"] | None = option(
        default=None, help="What the transforms of --calibration are. Default: what the images show."
    )
    rig_axes: str | None = option(
        default=None,
        help="Axes x, y, z of the vehicle in --calibration, such as flu: f forward, b backward, l left, r right, u up, "
        "d down. Default: what the images show.",
        metavar="XYZ",
    )
    camera_axes: Literal["optical", "vehicle", "opengl", "unity", "unreal", "ned"] | None = option(
        default=None,
        help="Axes of the cameras in --calibration: x right, y down (optical); x forward, y left (vehicle); x right, y "
        "up, z backward (opengl) or forward (unity); x forward, y right, z up (unreal) or down (ned).",
    )
    rig_angles: RigAngles | None = option(
        default=None,
        help="Rotation in --calibration: a quaternion (wxyz, xyzw), a rotation vector (vector), or roll, pitch and yaw "
        "(radians, degrees, clockwise, clockwise-radians, or unity: about z, x and y). Default: what the images show.",
        metavar="ANGLES",
    )
    rig_unit: Literal["m", "cm", "mm", "in", "ft"] | None = option(
        default=None, help="Unit of the translations in --calibration. Default: the one that gives a vehicle."
    )
    fov_deg: float | Mapping[str, float] | None = option(
        default=None,
        help="Horizontal field of view, degrees: a rig without calibration. Repeatable.",
        flag="--fov",
        metavar="[CAMERA=]DEG",
        parse=parse_by_camera,
        repeatable=True,
    )
    height: float | Mapping[str, float] | None = option(
        default=None,
        help="Height of the cameras above the ground, metres. Repeatable.",
        metavar="[CAMERA=]M",
        parse=parse_by_camera,
        repeatable=True,
    )
    yaw_deg: float | Mapping[str, float] | None = option(
        default=None,
        help="Viewing direction of a camera without a pose, degrees counter-clockwise from ahead. Default for a single "
        "camera: 0. Repeatable.",
        flag="--yaw",
        metavar="[CAMERA=]DEG",
        parse=parse_by_camera,
        repeatable=True,
    )
    ego_motion_file: Path | None = option(
        reads="path",
        default=None,
        help="Poses that replace the ego-motion of the input: ego_motion.csv, TUM, KITTI, EuRoC, or a table of "
        "positions or GPS (docs/other-inputs.md).",
        flag="--ego-motion",
        metavar="FILE",
    )
    pose_times: TimeUnit | None = option(
        default=None, help="Unit of the times in --ego-motion. Default: the only possible one."
    )
    pose_angles: PoseAngles | None = option(
        default=None,
        help="Angles in --ego-motion: radians or degrees, compass or compass-radians (clockwise from north), clockwise "
        "or clockwise-radians (from x), or vector; or the order of its quaternions, wxyz or xyzw. Default: what the "
        "images show.",
        metavar="ANGLES",
    )
    pose_unit: Literal["m", "cm", "mm", "ft"] | None = option(
        default=None, help="Unit of the positions in --ego-motion. Default: metres, if a vehicle can be as fast."
    )
    poses_of: str | None = option(
        default=None,
        help='Camera whose poses --ego-motion has, or "vehicle". Default: what the images show.',
        metavar="CAMERA|vehicle",
    )
    pose_axes: str | None = option(
        default=None,
        help="Axes of the vehicle, or of the camera, in --ego-motion, as --rig-axes. Default: what the images show.",
        metavar="XYZ",
    )
    pose_transform: Literal["world_from_body", "body_from_world"] | None = option(
        default=None, help="What the poses of --ego-motion are. Default: what the images show."
    )
    image_check: bool = option(
        default=True,
        help="Compare what --calibration and --ego-motion may mean with the images.",
        flag="--image-check/--no-image-check",
    )
