"""One nuScenes scene: its rig, its poses, and the data of the CAN bus expansion."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.geometry.cameras import Camera, CameraRig, brown_conrady
from bevcli.geometry.ego_motion import EgoMotion, Kinematics, motion_of_keyframes
from bevcli.geometry.transforms import Array, Pose
from bevcli.sequences.files.calibration_file import LARGEST_SIZE, is_file_name
from bevcli.sequences.nuscenes.index import Dialect, NuScenesIndex
from bevcli.sequences.nuscenes.json_tables import read_rows

# The order of nuScenes' cameras in a rig. Other cameras follow, sorted by name.
CAMERAS = ("CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_FRONT_LEFT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_BACK_RIGHT")


@dataclass(frozen=True)
class CanBus:
    """The T pose messages of a scene in the CAN bus expansion.

    Attributes:
        times_us: (T,) microseconds, increasing.
        accelerations: (T, 3) m/s² with gravity, ego frame.
        angular_rates: (T, 3) rad/s, ego frame.
        velocities: (T, 3) m/s, ego frame.
    """

    times_us: NDArray[np.int64]
    accelerations: Array
    angular_rates: Array
    velocities: Array

    def kinematics_at(self, timestamp_ns: int) -> Kinematics:
        """The first message after a time, or the last message. The published models were trained this way."""
        row = min(int(np.searchsorted(self.times_us, timestamp_ns // 1000, side="right")), len(self.times_us) - 1)
        return Kinematics(self.accelerations[row], self.angular_rates[row], self.velocities[row])


def read_scene(
    index: NuScenesIndex, root: Path, dialect: Dialect, scene: int
) -> tuple[CameraRig, EgoMotion, CanBus | EgoMotion]:
    """The rig and the poses of a scene, and its kinematics: from the CAN bus data, or from the poses without any.

    scene: its row in the index. Raises InputError.
    """
    rig, motion = scene_rig(index, dialect, scene), scene_motion(index, scene)
    return rig, motion, read_can_bus(root, str(index.scenes.names[scene])) or motion


def scene_rig(index: NuScenesIndex, dialect: Dialect, scene: int) -> CameraRig:
    """The rig of a scene. Raises InputError."""
    first, last = index.scenes.first_image[scene : scene + 2]
    sensors, rows = np.unique(index.images.sensors[first:last], return_index=True)
    cameras = [_camera(index, int(sensor), first + row) for sensor, row in zip(sensors, rows, strict=True)]
    cameras.sort(key=lambda camera: (CAMERAS.index(camera.name) if camera.name in CAMERAS else 99, camera.name))
    if len({camera.name for camera in cameras}) < len(cameras):
        raise InputError(f"scene {index.scenes.names[scene]}: a camera changes its calibration within the scene")
    if dialect.ego_from_bev is not None:
        return CameraRig(tuple(cameras), dialect.ego_from_bev, ego_from_bev_assumed=True)
    lidar = int(index.samples.lidars[index.scenes.first_sample[scene]])
    return CameraRig(tuple(cameras), _sensor_pose(index, lidar).matrix)


def scene_motion(index: NuScenesIndex, scene: int) -> EgoMotion:
    """A scene's poses at the times of its keyframes and images, see `motion_of_keyframes`."""
    samples, images = index.samples, index.images
    keys = slice(*index.scenes.first_sample[scene : scene + 2])
    rows = slice(*index.scenes.first_image[scene : scene + 2])
    return motion_of_keyframes(
        (samples.times_us[keys] * 1000, samples.translations[keys], samples.quaternions[keys]),
        (images.times_us[rows] * 1000, images.translations[rows], images.quaternions[rows]),
    )


def read_can_bus(root: Path, scene: str) -> CanBus | None:
    """A scene's messages, None if the expansion does not have them. Raises InputError for an invalid file."""
    path = root / "can_bus" / f"{scene}_pose.json"
    if not path.is_file():
        return None
    rows = read_rows(path)
    if not rows:
        return None
    times = rows.integers("utime")
    quantities = [rows.vectors(name, 3) for name in ("accel", "rotation_rate", "vel")]
    order = np.argsort(times, kind="stable")
    return CanBus(times[order], *(values[order] for values in quantities))


def _camera(index: NuScenesIndex, sensor: int, image: int) -> Camera:
    width, height = (int(value) for value in index.images.sizes[image])
    name = str(index.sensors.channels[sensor])
    if not is_file_name(name) or not 0 < min(width, height) <= max(width, height) <= LARGEST_SIZE:
        raise InputError(
            f'camera "{name:.60}": expected a name without a slash and an image size, found {width}x{height}'
        )
    intrinsics, lens = np.array(index.sensors.intrinsics[sensor]), brown_conrady(index.sensors.distortions[sensor])
    return Camera(name, width, height, intrinsics, _sensor_pose(index, sensor).matrix, lens)


def _sensor_pose(index: NuScenesIndex, sensor: int) -> Pose:
    return Pose(index.sensors.translations[sensor], index.sensors.quaternions[sensor])
