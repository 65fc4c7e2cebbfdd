"""An Argoverse 2 log as a drive.

Argoverse's egovehicle frame is at the rear axle, above the ground. The ego frame here is below it, on the ground.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa  # which rerun brings, so that it is installed anyway
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import Camera, CameraRig, brown_conrady, default_ego_from_bev
from bevcli.geometry.ego_motion import EgoMotion
from bevcli.geometry.transforms import Array, Pose, rigid, rotation_from_quaternion, yaw_of_rotation
from bevcli.parsing.documents import LARGEST_INTEGER
from bevcli.parsing.files import MIB, read_bytes
from bevcli.printing import reason_of
from bevcli.sequences.files.boxes_file import ClassNames
from bevcli.sequences.files.calibration_file import checked_camera
from bevcli.sequences.images import FrameEntry, ImageSource, ListedDrive, bev_frame_notes
from bevcli.sequences.options import InputOptions
from bevcli.workshop.formats import Argoverse2Options
from bevcli.workshop.formats.labels import names_of_format, with_track_velocities
from bevcli.workshop.formats.matching import FARTHEST, CameraImages, frames_at
from bevcli.workshop.formats.poses import motion_of_keyframes

# Class names; docs/other-inputs.md says what is lost. Names are compared without case; others, such as BOLLARD, SIGN
# and STROLLER, stay as they are, and are not scored.
CATEGORIES_OF_CLASS = {
    "car": ("REGULAR_VEHICLE",),
    "truck": ("LARGE_VEHICLE", "BOX_TRUCK", "TRUCK", "TRUCK_CAB"),
    "bus": ("BUS", "SCHOOL_BUS", "ARTICULATED_BUS"),
    "trailer": ("VEHICULAR_TRAILER", "MESSAGE_BOARD_TRAILER", "TRAFFIC_LIGHT_TRAILER"),
    "motorcycle": ("MOTORCYCLE",),
    "bicycle": ("BICYCLE",),
    "pedestrian": ("PEDESTRIAN", "OFFICIAL_SIGNALER"),
    "traffic_cone": ("CONSTRUCTION_CONE", "CONSTRUCTION_BARREL"),
}
CLASS_OF_CATEGORY = {name: class_name for class_name, names in CATEGORIES_OF_CLASS.items() for name in names}
LARGEST_BYTES = 256 * MIB
LARGEST_NUMBER = 1e12  # metres or pixels
SHORTEST_QUATERNION = 1e-3
QUATERNION, TRANSLATION = ("qw", "qx", "qy", "qz"), ("tx_m", "ty_m", "tz_m")
POSE = (*QUATERNION, *TRANSLATION)
Table = Mapping[str, NDArray[Any]]  # columns by name
RING = (
    "ring_front_center", "ring_front_right", "ring_front_left", "ring_side_right", "ring_side_left",
    "ring_rear_right", "ring_rear_left",
)  # fmt: skip
STEREO = ("stereo_front_left", "stereo_front_right")
LENS = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "k3")
SPACING_NS = 100_000_000  # time between the poses that kinematics are derived from; the table has some 5 µs apart
PERIOD_NS = 52_000_000  # from one image of a camera to the next, of which it has 20 per second, and some jitter
SIZE = ("length_m", "width_m", "height_m")
ANNOTATIONS = "annotations.feather"


def read_feather(
    path: Path, *, texts: Iterable[str] = (), integers: Iterable[str] = (), numbers: Iterable[str]
) -> Table:
    """The columns of a Feather file, by name. Raises InputError where the file is missing or broken, or lacks a value.

    texts, integers, numbers: names of columns; numbers are finite.
    """
    data = read_bytes(path, LARGEST_BYTES)
    try:
        table = pa.ipc.open_file(pa.BufferReader(data)).read_all()
        table.validate(full=True)
    except (pa.ArrowException, OSError, ValueError, MemoryError) as error:
        raise InputError(f"{path}: is not a complete Feather file ({reason_of(error)[:200]})") from None
    kinds = {pa.string(): texts, pa.int64(): integers, pa.float64(): numbers}
    columns: dict[str, NDArray[Any]] = {}
    for kind, name in ((kind, name) for kind, names in kinds.items() for name in names):
        if table.column_names.count(name) != 1:
            raise InputError(f'{path}: has no column "{name:.60}" (found: {", ".join(table.column_names[:20]):.200})')
        column = table[name]
        is_sound = not column.null_count and pa.types.is_string(kind) == (not pa.types.is_primitive(column.type))
        try:
            columns[name] = (column.cast(kind) if is_sound else pa.array([])).to_numpy()
        except pa.ArrowException:
            is_sound = False
        if not is_sound:
            found = f"{column.type}{' with missing values' if column.null_count else ''}"
            raise InputError(f'{path}: column "{name}": expected {kind}, found {found:.80}')
        if kind == pa.float64() and not (is_finite := np.abs(columns[name]) < LARGEST_NUMBER).all():
            row = int(is_finite.argmin())
            found = f"{columns[name][row]:g} in row {row}"
            raise InputError(f'{path}: column "{name}": expected finite numbers below 1e12, found {found}')
    return columns


def _stacked(table: Table, names: Iterable[str]) -> Array:
    """(N, C) columns of numbers."""
    return np.stack([table[name] for name in names], axis=1)


def _poses(table: Table, path: Path) -> tuple[Array, Array]:
    """(N, 3) translations, metres, and (N, 4) quaternions w, x, y, z of norm 1. Raises InputError."""
    quaternions = _stacked(table, QUATERNION)
    norms = np.linalg.norm(quaternions, axis=1, keepdims=True)
    if not (norms > SHORTEST_QUATERNION).all():
        raise InputError(f"{path}: expected quaternions of norm 1, found one of norm 0")
    return _stacked(table, TRANSLATION), quaternions / norms


def open_log(path: Path, common: InputOptions, options: Argoverse2Options) -> ListedDrive:
    """A log of the Argoverse 2 sensor dataset: a frame for each time that has boxes, 10 per second.

    A log without boxes has a frame for each image of the front camera. Each camera contributes its nearest image.
    The ego frame is below Argoverse's, on the ground. The world frame is that of the city. Raises InputError.
    """
    common.refuse_static(path)
    rig = _read_rig(path / "calibration", options)
    motion = _read_motion(path / "city_SE3_egovehicle.feather", options.axle_height_m)
    images = {name: _images(path / "sensors/cameras" / name) for name in rig.names}
    annotated = (path / ANNOTATIONS).exists()
    names = names_of_format(CLASS_OF_CATEGORY, common.class_map)
    boxes = _read_annotations(path / ANNOTATIONS, motion, options, names) if annotated else {}
    entries, notes = _entries(path, images, np.array(sorted(boxes), dtype=np.int64))
    times = [entry.stamp.timestamp_ns for entry in entries] if common.ground_truth else []
    truth = {index: boxes[time] for index, time in enumerate(times) if time in boxes}
    notes = (*bev_frame_notes(rig, "an Argoverse 2 log"), *notes)
    files = tuple(sorted((*path.glob("*.feather"), *path.glob("calibration/*.feather"))))
    return ListedDrive(path, common, rig, entries, motion, truth, notes, files)


def _read_motion(path: Path, axle_height_m: float) -> EgoMotion:
    """The poses in city_SE3_egovehicle.feather, as those of the frame below the axle. Raises InputError."""
    table = read_feather(path, integers=["timestamp_ns"], numbers=POSE)
    times, first = np.unique(table["timestamp_ns"], return_index=True)
    if not len(times):
        raise InputError(f"{path}: has no poses (expected at least one)")
    axles, quaternions = (column[first] for column in _poses(table, path))
    up = rotation_from_quaternion(quaternions)[..., 2]
    poses = (times, axles - axle_height_m * up, quaternions)
    rows = np.unique(np.searchsorted(times, np.arange(times[0], times[-1] + 1, SPACING_NS)))
    return motion_of_keyframes((times[rows], poses[1][rows], quaternions[rows]), poses)


def _read_rig(folder: Path, options: Argoverse2Options) -> CameraRig:
    path, poses_path = folder / "intrinsics.feather", folder / "egovehicle_SE3_sensor.feather"
    table = read_feather(path, texts=["sensor_name"], integers=["width_px", "height_px"], numbers=LENS)
    lenses = dict(zip(table["sensor_name"], _stacked(table, LENS), strict=True))
    sizes = _stacked(table, ("width_px", "height_px")).tolist()
    size_of = dict(zip(lenses, sizes, strict=True)) if len(lenses) == len(sizes) else {}
    poses = read_feather(poses_path, texts=["sensor_name"], numbers=POSE)
    axle_from = dict(zip(poses["sensor_name"], map(Pose, *_poses(poses, poses_path)), strict=True))
    names = [name for name in RING if name in lenses] + (list(STEREO) if options.stereo else [])
    if not names:
        raise InputError(f"{path}: has none of the ring cameras (expected {RING[0]} and others)")
    for name in names:
        for table_of_name, file in ((lenses, path), (size_of, path), (axle_from, poses_path)):
            if name not in table_of_name:
                raise InputError(f"{file}: has no row of {name}, or two of one camera (expected one)")
    ego_from_axle = rigid((0, 0, options.axle_height_m))
    ego_from = {name: ego_from_axle @ axle_from[name].matrix for name in names}
    cameras = [_camera(name, size_of[name], lenses[name], ego_from[name], path, options) for name in names]
    return CameraRig(tuple(cameras), default_ego_from_bev(), ego_from_bev_assumed=True)


def _camera(
    name: str, size: list[int], lens: Array, ego_from_camera: Array, path: Path, options: Argoverse2Options
) -> Camera:
    (width, height), (fx, fy, cx, cy, k1, k2, k3) = size, lens
    intrinsics = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    distortion = brown_conrady((k1, k2, 0, 0, k3, 0, 0, 0)) if options.distorted else None
    return checked_camera(Camera(name, width, height, intrinsics, ego_from_camera, distortion), path)


def _images(folder: Path) -> CameraImages:
    """The images TIMESTAMP.jpg in a camera's folder; none without the folder."""
    names = [file.stem for file in folder.glob("*.jpg")] if folder.is_dir() else []
    numbers = (int(name) for name in names if name.isascii() and name.isdecimal() and len(name) <= 19)
    times = sorted(time for time in numbers if time <= LARGEST_INTEGER)
    sources = [ImageSource(folder / f"{time}.jpg", time) for time in times]
    return CameraImages(f"the folder {folder.name}", np.array(times, dtype=np.int64), PERIOD_NS, sources.__getitem__)


def _read_annotations(
    path: Path, motion: EgoMotion, options: Argoverse2Options, names: ClassNames
) -> dict[int, Boxes3D]:
    texts, integers = ("track_uuid", "category"), ("timestamp_ns", "num_interior_pts")
    table = read_feather(path, texts=texts, integers=integers, numbers=(*SIZE, *POSE))
    translations, quaternions = _poses(table, path)
    times = table["timestamp_ns"]
    boxes = Boxes3D(
        translations + [0, 0, options.axle_height_m],
        _stacked(table, SIZE),
        np.array([yaw_of_rotation(rotation_from_quaternion(q)) for q in quaternions], dtype=np.float64),
        np.full((len(times), 2), np.nan),
        np.array([names[name] for name in table["category"]], dtype=np.str_),
        instances=table["track_uuid"].astype(np.str_),
        num_points=table["num_interior_pts"],
    )
    frames = np.unique(times)
    try:
        in_city = [boxes[times == time].transformed(motion.pose_at(int(time)).matrix) for time in frames]
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return dict(zip(frames.tolist(), with_track_velocities(in_city, frames.tolist()), strict=True))


def _entries(
    path: Path, images: Mapping[str, CameraImages], annotated: NDArray[np.int64]
) -> tuple[tuple[FrameEntry, ...], tuple[str, ...]]:
    folder = path / "sensors/cameras"
    leading = next((name for name, of_camera in images.items() if len(of_camera.times_ns)), None)
    if leading is None:
        raise InputError(f"{folder}: has no images (expected {next(iter(images))}/TIMESTAMP_NS.jpg and others)")
    times = annotated if len(annotated) else images[leading].times_ns
    entries = frames_at(times, images, leading)
    if not entries:
        near = f"within {FARTHEST * PERIOD_NS / 1e6:.0f} ms"
        raise InputError(f"{path}: no image is {near} of a time that has boxes in {ANNOTATIONS}")
    note = f"{len(times) - len(entries)} of {len(times)} frames have no image and are left out"
    return entries, (note,) if len(entries) < len(times) else ()
