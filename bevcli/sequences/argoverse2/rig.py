"""The cameras of an Argoverse 2 log, its poses, and the frame of reference of both.

Argoverse's egovehicle frame is at the rear axle, above the ground. The ego frame here is below it, on the ground.
"""

from pathlib import Path

import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.cameras import Camera, CameraRig, brown_conrady, default_ego_from_bev
from bevcli.geometry.ego_motion import EgoMotion, motion_of_keyframes
from bevcli.geometry.transforms import Array, Pose, rigid, rotation_from_quaternion
from bevcli.sequences.argoverse2.feather import QUATERNION, TRANSLATION, FeatherTable
from bevcli.sequences.argoverse2.format import Argoverse2Options
from bevcli.sequences.files.calibration_file import LARGEST_SIZE

RING = (
    "ring_front_center", "ring_front_right", "ring_front_left", "ring_side_right", "ring_side_left",
    "ring_rear_right", "ring_rear_left",
)  # fmt: skip
STEREO = ("stereo_front_left", "stereo_front_right")
LENS = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "k3")
SPACING_NS = 100_000_000  # time between the poses that kinematics are derived from; the table has some 5 µs apart


def read_motion(path: Path, axle_height_m: float) -> EgoMotion:
    """The poses in city_SE3_egovehicle.feather, as those of the frame below the axle. Raises InputError."""
    table = FeatherTable(path, ("timestamp_ns", *QUATERNION, *TRANSLATION))
    if not len(table):
        raise InputError(f"{path}: has no poses (expected at least one)")
    times, first = np.unique(table.integers("timestamp_ns"), return_index=True)
    axles, quaternions = (column[first] for column in table.poses())
    up = np.stack([rotation_from_quaternion(q)[:, 2] for q in quaternions])
    poses = (times, axles - axle_height_m * up, quaternions)
    rows = np.unique(np.searchsorted(times, np.arange(times[0], times[-1] + 1, SPACING_NS)))
    return motion_of_keyframes((times[rows], poses[1][rows], quaternions[rows]), poses)


def read_rig(folder: Path, own: Argoverse2Options) -> CameraRig:
    """The cameras of a log's calibration folder. Raises InputError."""
    path, poses_path = folder / "intrinsics.feather", folder / "egovehicle_SE3_sensor.feather"
    table = FeatherTable(path, ("sensor_name", *LENS, "width_px", "height_px"))
    lenses = dict(zip(table.texts("sensor_name"), table.numbers(LENS), strict=True))
    sizes = np.stack([table.integers("width_px"), table.integers("height_px")], axis=1)
    size_of = dict(zip(lenses, sizes.tolist(), strict=True)) if len(lenses) == len(table) else {}
    poses = FeatherTable(poses_path, ("sensor_name", *QUATERNION, *TRANSLATION))
    axle_from = dict(zip(poses.texts("sensor_name"), map(Pose, *poses.poses()), strict=True))
    names = [name for name in RING if name in lenses] + (list(STEREO) if own.stereo else [])
    if not names:
        raise InputError(f"{path}: has none of the ring cameras (expected {RING[0]} and others)")
    for name in names:
        for known, file in ((lenses, path), (size_of, path), (axle_from, poses_path)):
            if name not in known:
                raise InputError(f"{file}: has no row of {name}, or two of one camera (expected one)")
    ego_from_axle = rigid((0, 0, own.axle_height_m))
    cameras = [
        _camera(
            name, size_of[name], lenses[name], ego_from_axle @ axle_from[name].matrix, path, distorted=own.distorted
        )
        for name in names
    ]
    return CameraRig(tuple(cameras), default_ego_from_bev(), ego_from_bev_assumed=True)


def _camera(name: str, size: list[int], lens: Array, ego_from_camera: Array, path: Path, *, distorted: bool) -> Camera:
    width, height = size
    fx, fy, cx, cy, k1, k2, k3 = lens
    if not (0 < min(size) <= max(size) <= LARGEST_SIZE and min(fx, fy) > 0):
        raise InputError(
            f"{path}: {name}: expected an image size and focal lengths above 0, found {width}x{height}, {fx:g}, {fy:g}"
        )
    intrinsics = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    distortion = brown_conrady((k1, k2, 0, 0, k3, 0, 0, 0)) if distorted else None
    return Camera(name, width, height, intrinsics, ego_from_camera, distortion)
