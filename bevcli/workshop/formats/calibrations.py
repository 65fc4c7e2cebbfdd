"""`read_rig`: the rig of any calibration, or of a field of view, a height and a yaw.

`KINDS` are the kinds of files and their readers. A reader makes a `StatedCamera` of what a file states of a camera;
`bevcli.workshop.formats.camera_poses` decides what a transform means.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from bevcli.errors import Finding, InputError
from bevcli.geometry.cameras import CameraRig, default_ego_from_bev
from bevcli.geometry.transforms import Array, inverse
from bevcli.options import named
from bevcli.parsing.files import read_bytes
from bevcli.printing import counted
from bevcli.sequences.files.calibration_file import RigDraft, parse_camera
from bevcli.sequences.files.json_fields import parse_transform, require, transform_to_json
from bevcli.sequences.files.readings import RigReading
from bevcli.sequences.options import RigOptions
from bevcli.workshop.formats.camera_poses import (
    Cameras,
    Fields,
    StatedCamera,
    StatedPose,
    guessed_pose,
    raised,
    rig_readings,
)
from bevcli.workshop.formats.kitti import KITTI_FILES, read_kitti
from bevcli.workshop.formats.markup import YAML_BYTES
from bevcli.workshop.formats.matching import cameras_with_images, first_images, size_of_first
from bevcli.workshop.formats.named_calibration import SUFFIXES, read_document, read_named
from bevcli.workshop.formats.other_calibrations import read_colmap, read_information, read_nerfstudio, read_vins_fusion

ByCamera = float | Mapping[str, float] | None  # one number for all cameras, or one for each
FOV_DEG = (5, 170)  # of a pinhole camera
SEVERAL = "is the video of one camera, but the calibration has {} ({}): name the video after its camera"
OPEN_LENS = (
    "{}: the four coefficients of {} are taken as k1, k2, p1, p2; if they are k1 to k4 of a fisheye (cv2.fisheye), "
    "state distortion_model: fisheye beside them"
)
HIGHEST_M = 10.0  # of a camera that is stated
LARGEST_SHARE = 5.0  # of a focal length, in sizes of the image; in pixels it is larger


def read_rig(
    calibration: Path | None,
    drive: Path | None = None,
    *,
    extrinsics: Path | None = None,
    fov_deg: ByCamera = None,
    height: ByCamera = None,
    yaw_deg: ByCamera = None,
    **stated: str,
) -> RigDraft:
    """The rig of a file or folder of any kind, or of numbers. A finding says how it was understood. Raises InputError.

    drive: whose first images state sizes that the calibration does not. Others: see `RigOptions`.
    """
    if calibration is None:
        if fov_deg is None:
            raise InputError(_incomplete(extrinsics, next(iter(stated), "yaw_deg" if height is None else "height")))
        return _guessed_rig(drive, fov_deg, height, yaw_deg)
    if fov_deg is not None:
        raise InputError("`calibration` (`--calibration`) and `fov_deg` (`--fov`) exclude each other: pass one of them")
    format_name, cameras = _read_cameras(calibration)
    if not cameras:
        raise InputError(f"{calibration}: {format_name}: has no camera (expected one or more)")
    if extrinsics is not None:
        poses = _extrinsics(extrinsics)
        if len(poses) == len(cameras) == 1:  # whatever each file calls it
            poses = dict(zip(cameras, poses.values(), strict=True))
        for name in poses.keys() - cameras.keys():
            raise InputError(f"{extrinsics}: camera {name}: has no intrinsics (found those of {', '.join(cameras)})")
        cameras = {name: replace(of, pose=poses[name].pose if name in poses else None) for name, of in cameras.items()}
    cameras = _named_as_images(_along_chain(cameras), drive)
    where = calibration if extrinsics is None else extrinsics
    used, left_out = cameras_with_images(cameras, drive)
    # The poses of cameras without images tell how those of the others are meant.
    posed = {name: of for name, of in cameras.items() if name in used or of.pose is not None}
    readings, how = _readings(where, posed, stated, height, yaw_deg)
    ego_from_camera = readings[0].ego_from_camera
    fields = {name: _fields(name, of, ego_from_camera[name], calibration, drive)
              for name, of in cameras.items() if name in used}  # fmt: skip
    how = f"{counted(len(fields), 'cameras')}; {how or poses_in_words(readings[0])}"
    rig, findings = _rig(fields, where, _bev_frame(where), f"{calibration.name}: {format_name}: {how}", left_out)
    if is_open := [name for name in used if cameras[name].lens_is_open]:
        findings.append(Finding("lens-assumed", "info", None, OPEN_LENS.format(calibration.name, ", ".join(is_open))))
    readings = readings if readings[0].states else ()
    others = _readings(where, posed, {}, height, yaw_deg)[0] if stated else ()
    return RigDraft(rig, tuple(findings), readings=readings, others=others, file=where)


def _rig(
    fields: Mapping[str, Fields], where: Path | None, ego_from_bev: Array | None, *words: str
) -> tuple[CameraRig, list[Finding]]:
    """The rig of cameras as in calibration.json, and how it was understood."""
    cameras = tuple(require(parse_camera, name, of, where=str(where), camera=name) for name, of in fields.items())
    bev = default_ego_from_bev() if ego_from_bev is None else ego_from_bev
    finding = Finding("calibration-read", "info", None, "; ".join(filter(None, words)))
    return CameraRig(cameras, bev, ego_from_bev is None), [finding]


def _incomplete(extrinsics: Path | None, option: str) -> str:
    if extrinsics is not None:
        return (
            "`intrinsics` (`--intrinsics`) and `extrinsics` (`--extrinsics`) must be given together: pass both, or "
            "pass `calibration` (`--calibration`)"
        )
    return (
        f"{named(RigOptions, option)} needs a field of view or a calibration: pass `fov_deg=70` (`--fov 70`) or "
        "`calibration` (`--calibration FILE`)"
    )


def _readings(
    where: Path, cameras: Cameras, stated: Mapping[str, str], height: ByCamera, yaw_deg: ByCamera
) -> tuple[tuple[RigReading, ...], str]:
    """What the poses of the cameras may be, and how they were found where no file states them."""
    pose_of = {name: of.pose for name, of in cameras.items() if of.pose is not None}
    lacking = [name for name in cameras if name not in pose_of]
    if not pose_of and height is not None:
        starts = tuple(name for name, of in cameras.items() if of.from_previous is None) or tuple(cameras)
        guessed, how = _guessed_poses(starts, height, yaw_deg)
        guessed_poses = {name: StatedPose({"": pose}, "ego_from_camera", exact=True) for name, pose in guessed.items()}
        linked = _along_chain({name: replace(of, pose=guessed_poses.get(name)) for name, of in cameras.items()})
        return rig_readings(where, {name: of.pose for name, of in linked.items() if of.pose}, {}), how
    if lacking:
        why = "moves through the file, as in a reconstruction" if cameras[lacking[0]].moves else "is missing"
        raise InputError(
            f'{where}: camera {lacking[0]}: its pose (T, extrinsics or "ego_from_camera") {why}: add it, pass '
            "`extrinsics` (`--extrinsics FILE`), or pass `height` (`--height`) and `yaw_deg` (`--yaw`)"
        )
    if yaw_deg is not None:
        raise InputError(f"{where}: states the poses of the cameras: remove `yaw_deg` (`--yaw`)")
    heights = _by_camera(height, tuple(cameras), "height")
    if all(pose.exact for pose in pose_of.values()):
        for name in stated:
            raise InputError(f"{where}: states what its transforms mean: remove {named(RigOptions, name)}")
    readings = rig_readings(where, pose_of, stated, height_stated=bool(heights))
    if heights:
        readings = tuple(replace(each, ego_from_camera=raised(each.ego_from_camera, heights)) for each in readings)
    return readings, ""


def poses_in_words(reading: RigReading) -> str:
    """A reading of a rig, and where its cameras look."""
    yaws = ", ".join(
        f"{name} {np.degrees(np.arctan2(pose[1, 2], pose[0, 2])):.0f}°"
        for name, pose in reading.ego_from_camera.items()
    )
    return f"{reading.words() or 'poses as stated'}; yaw {yaws}"


def _fields(name: str, of: StatedCamera, ego_from_camera: Array, path: Path, drive: Path | None) -> Fields:
    """The fields of a camera, as in calibration.json."""
    if of.intrinsics is None:
        raise InputError(
            f"{path}: camera {name}: has no intrinsics (expected K, camera_matrix, intrinsics or fx, fy, cx, cy; "
            "from a horizontal field of view, fx and fy are width / 2 / tan(fov / 2))"
        )
    size = of.size or size_of_first(drive, name)
    if size is None:
        raise InputError(
            f"{path}: camera {name}: the image size is missing, and no image of it was found: add width and height, or "
            f"name the folder of its images {name}"
        )
    sides = {key: int(value) if isinstance(value, float) and value.is_integer() else value
             for key, value in zip(("width", "height"), size, strict=True)}  # fmt: skip
    pose = {"ego_from_camera": transform_to_json(ego_from_camera)}
    matrix = np.array(of.intrinsics)
    if matrix[:2].max() < LARGEST_SHARE and all(isinstance(side, int) for side in sides.values()):
        matrix[:2] *= np.array([[sides["width"]], [sides["height"]]])
    return {**sides, "intrinsics": matrix.tolist(), "distortion": of.distortion, **pose}


def _named_as_images(cameras: Cameras, drive: Path | None) -> Cameras:
    """A single camera has the name of the only folder or video with images; of several, a video is one by its name."""
    image_names = list(first_images(drive)) if drive is not None else []
    if len(cameras) == len(image_names) == 1:
        return {image_names[0]: next(iter(cameras.values()))}
    if drive is None or not drive.is_file() or not image_names:
        return cameras
    if image_names[0] not in cameras:
        raise InputError(f"{drive}: {SEVERAL.format(counted(len(cameras), 'cameras'), ', '.join(cameras))}")
    return {image_names[0]: cameras[image_names[0]]}


# Kinds of files


def _read_cameras(path: Path) -> tuple[str, Cameras]:
    """What a calibration is, in words, and its cameras."""
    for format_name, read in KINDS.items():
        if (cameras := read(path)) is not None:
            return format_name, cameras
    if path.is_dir():
        raise InputError(
            f"{path}: has no calibration (expected calibration.json, a file a camera ({', '.join(SUFFIXES)}), "
            f"cameras.txt, transforms.json or {KITTI_FILES[0]})"
        )
    read_bytes(path, YAML_BYTES)  # says what is missing or no file
    raise InputError(
        f"{path}: is no known calibration (expected {', '.join(SUFFIXES)}, or cameras.txt of COLMAP, or KITTI's)"
    )


def _extrinsics(path: Path) -> Cameras:
    """The cameras of a file with poses."""
    if path.suffix.lower() == ".json" and not isinstance(read_document(path), (dict, list)):
        raise InputError(
            f'{path}: "cameras" is missing (expected {{"cameras": {{"cam0": {{"ego_from_camera": ...}}}}}})'
        )
    return _read_cameras(path)[1]


def _bev_frame(path: Path) -> Array | None:
    """(4, 4) ego_from_bev of a file that states it."""
    document = read_document(path) if path.suffix.lower() in SUFFIXES and not path.is_dir() else None
    is_stated = isinstance(document, dict) and "ego_from_bev" in document
    return require(parse_transform, document, "ego_from_bev", where=path) if is_stated else None


def _along_chain(cameras: Cameras) -> Cameras:
    """Poses of cameras without one by that of a neighbour in Kalibr's chain, in the file's order."""
    linked, pairs = dict(cameras), list(pairwise(cameras))
    for neighbour, other in [*pairs, *((name, earlier) for earlier, name in reversed(pairs))]:
        is_next = (neighbour, other) in pairs
        link, pose = linked[other if is_next else neighbour].from_previous, linked[neighbour].pose
        if linked[other].pose is None and pose is not None and link is not None:
            linked[other] = replace(linked[other], pose=pose.moved(inverse(link) if is_next else link))
    return linked


# Without any file


def _guessed_rig(drive: Path | None, fov_deg: ByCamera, height: ByCamera, yaw_deg: ByCamera) -> RigDraft:
    names = list(first_images(drive)) if drive is not None else []
    if not names:
        raise InputError(f"{drive}: has no images of a camera (expected images/CAMERA/*.jpg, or a video)")
    if height is None:
        raise InputError(
            "`fov_deg` (`--fov`) needs the height of the camera above the ground: pass `height=1.5` (`--height 1.5`)"
        )
    fovs = _by_camera(fov_deg, tuple(names), "fov_deg")
    poses, how = _guessed_poses(tuple(names), height, yaw_deg)
    cameras = {}
    for name in names:
        size = size_of_first(drive, name)
        if size is None:
            raise InputError(f"{drive}: camera {name}: its first image cannot be read: bring it back")
        if not FOV_DEG[0] <= fovs[name] <= FOV_DEG[1]:
            expected = "the horizontal field of view, 5 to 170 degrees"
            raise InputError(f"`fov_deg={fovs[name]:g}` (`--fov`): expected {expected}")
        width, tall = size
        focal = width / 2 / np.tan(np.radians(fovs[name]) / 2)
        matrix = [[focal, 0, (width - 1) / 2], [0, focal, (tall - 1) / 2], [0, 0, 1]]
        pose = transform_to_json(poses[name])
        cameras[name] = {"width": width, "height": tall, "intrinsics": matrix, "ego_from_camera": pose}
    text = f"without calibration: {counted(len(cameras), 'cameras')} without lens distortion, {how}"
    rig, findings = _rig(cameras, drive, None, text)
    return RigDraft(rig, tuple(findings))


def _guessed_poses(names: tuple[str, ...], height: ByCamera, yaw_deg: ByCamera) -> tuple[dict[str, Array], str]:
    if yaw_deg is None:
        if len(names) > 1:
            flags = " ".join(f"--yaw {name}=0" for name in names[:2])
            raise InputError(
                f"the directions of {counted(len(names), 'cameras')} are not stated: pass one for each by `yaw_deg` "
                f"(`{flags} …`)"
            )
        yaw_deg = 0.0
    heights, yaws = _by_camera(height, names, "height"), _by_camera(yaw_deg, names, "yaw_deg")
    if len(names) > 1 and not isinstance(yaw_deg, Mapping):
        raise InputError(
            f"`yaw_deg={yaw_deg:g}` (`--yaw`): is one direction for {counted(len(names), 'cameras')}: pass one for each"
        )
    for name in names:
        if not 0 < heights[name] <= HIGHEST_M:
            raise InputError(f"`height={heights[name]:g}` (`--height`): expected metres above the ground, 0 to 10")
    poses = {name: guessed_pose(heights[name], np.radians(yaws[name])) for name in names}
    text = "; ".join(
        f"{name} yaw {yaws[name]:g}°, {heights[name]:g} m high, {pose[0, 3]:.1f} m ahead of the rear axle"
        for name, pose in poses.items()
    )
    return poses, f"assumed level, {text}"


def _by_camera(value: ByCamera, names: tuple[str, ...], option: str) -> dict[str, float]:
    """A number for each camera; none where none is given. Raises InputError for an unknown camera or a missing one."""
    if value is None:
        return {}
    if not isinstance(value, Mapping):
        return dict.fromkeys(names, float(value))
    for name in value.keys() - set(names):
        raise InputError(f"{named(RigOptions, option)}: there is no camera {name} (expected {', '.join(names)})")
    for name in (name for name in names if name not in value):
        raise InputError(
            f"{named(RigOptions, option)}: camera {name} is missing: pass one for each camera, or one for all"
        )
    return {name: float(value[name]) for name in names}


# What a file is -> its reader, which returns None for another one. The first that fits is taken.
KINDS: dict[str, Callable[[Path], Cameras | None]] = {
    "information file of BEVDet or mmdetection3d": read_information,
    "VINS-Fusion": read_vins_fusion,
    "COLMAP": read_colmap,
    "nerfstudio": read_nerfstudio,
    "KITTI": read_kitti,
    "K, D and T by name": read_named,
}
