"""What holds for a whole scene of nuScenes: its rig, its poses, its CAN bus."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.cameras import Camera, CameraRig
from bevcli.geometry.ego_motion import EgoMotion, Kinematics, derive_kinematics
from bevcli.geometry.transforms import Pose
from bevcli.sequences.nuscenes.can_bus import CanBus, read_can_bus
from bevcli.sequences.nuscenes.index import NuScenesIndex

# The order in which nuScenes' cameras are told; others follow by name.
CAMERAS = ("CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_FRONT_LEFT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_BACK_RIGHT")


@dataclass(frozen=True)
class SceneFacts:
    """What holds for a whole scene. motion: all its poses. sensor_names: the camera of each calibrated sensor."""

    rig: CameraRig
    sensor_names: Mapping[int, str]
    motion: EgoMotion
    can_bus: CanBus | None

    def kinematics_at(self, timestamp_ns: int) -> Kinematics:
        """By the CAN bus where the scene has it, else from the poses."""
        if self.can_bus is None:
            return self.motion.kinematics_at(timestamp_ns)
        return self.can_bus.kinematics_at(timestamp_ns // 1000)


def read_scene_facts(index: NuScenesIndex, root: Path, scene: int) -> SceneFacts:
    """All of it, of the scene at a place of the index. Raises InputError."""
    rig, sensor_names = scene_rig(index, scene)
    can_bus = read_can_bus(root, str(index.scenes.names[scene]))
    return SceneFacts(rig, sensor_names, scene_motion(index, scene), can_bus)


def scene_rig(index: NuScenesIndex, scene: int) -> tuple[CameraRig, dict[int, str]]:
    """The rig of a scene, and the camera's name of each of its calibrated sensors."""
    first, last = index.scenes.first_image[scene : scene + 2]
    sensors, rows = np.unique(index.images.sensors[first:last], return_index=True)
    cameras = [_camera(index, int(sensor), first + row) for sensor, row in zip(sensors, rows, strict=True)]
    cameras.sort(key=lambda camera: (CAMERAS.index(camera.name) if camera.name in CAMERAS else 99, camera.name))
    names = {int(sensor): str(index.sensors.channels[sensor]) for sensor in sensors}
    if len({camera.name for camera in cameras}) < len(cameras):
        raise InputError(f"scene {index.scenes.names[scene]}: a camera changes its calibration within the scene")
    lidar = int(index.samples.lidars[index.scenes.first_sample[scene]])
    return CameraRig(tuple(cameras), _sensor_pose(index, lidar).matrix), names


def scene_motion(index: NuScenesIndex, scene: int) -> EgoMotion:
    """A scene's poses at its keyframes' and images' times; kinematics are derived from the keyframes' alone.

    Poses a few milliseconds apart would make differences of differences of their noise.
    """
    samples, images = index.samples, index.images
    keys = slice(*index.scenes.first_sample[scene : scene + 2])
    rows = slice(*index.scenes.first_image[scene : scene + 2])
    key_times = samples.times_us[keys] * 1000
    keyframes = (samples.translations[keys], samples.quaternions[keys])
    rough = EgoMotion(key_times, *keyframes, *derive_kinematics(key_times, *keyframes))
    # The first of equal times is kept: keyframes come first.
    times, first = np.unique(np.concatenate([key_times, images.times_us[rows] * 1000]), return_index=True)
    translations = np.concatenate([keyframes[0], images.translations[rows]])[first]
    quaternions = np.concatenate([keyframes[1], images.quaternions[rows]])[first]
    inside = np.clip(times, key_times[0], key_times[-1])
    derived = [rough.kinematics_at(int(time)) for time in inside]
    return EgoMotion(
        times,
        translations,
        quaternions,
        np.stack([k.acceleration for k in derived]),
        np.stack([k.angular_rate for k in derived]),
        np.stack([k.velocity for k in derived]),
    )


def _camera(index: NuScenesIndex, sensor: int, image: int) -> Camera:
    width, height = (int(value) for value in index.images.sizes[image])
    name = str(index.sensors.channels[sensor])
    return Camera(name, width, height, np.array(index.sensors.intrinsics[sensor]), _sensor_pose(index, sensor).matrix)


def _sensor_pose(index: NuScenesIndex, sensor: int) -> Pose:
    return Pose(index.sensors.translations[sensor], index.sensors.quaternions[sensor])
