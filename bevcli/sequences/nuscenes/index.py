"""What bevcli needs of nuScenes' tables, as arrays that follow each other scene by scene and sample by sample."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array, rotation_from_quaternion, yaw_of_rotation

Ints = NDArray[np.int64]

# nuScenes' categories -> the ten detection classes; others are not detected.
CLASS_OF_CATEGORY = {
    "movable_object.barrier": "barrier",
    "vehicle.bicycle": "bicycle",
    "vehicle.bus.bendy": "bus",
    "vehicle.bus.rigid": "bus",
    "vehicle.car": "car",
    "vehicle.construction": "construction_vehicle",
    "vehicle.motorcycle": "motorcycle",
    "human.pedestrian.adult": "pedestrian",
    "human.pedestrian.child": "pedestrian",
    "human.pedestrian.construction_worker": "pedestrian",
    "human.pedestrian.police_officer": "pedestrian",
    "movable_object.trafficcone": "traffic_cone",
    "vehicle.trailer": "trailer",
    "vehicle.truck": "truck",
}
BICYCLE_RACK = "static_object.bicycle_rack"


@dataclass(frozen=True)
class Scenes:
    """S scenes. names: (S,). first_sample, first_image: (S + 1,) where each scene's begin."""

    names: NDArray[np.str_]
    first_sample: Ints
    first_image: Ints


@dataclass(frozen=True)
class Sensors:
    """K calibrated sensors: channels (K,), ego_from_sensor translations (K, 3), quaternions (K, 4).

    intrinsics: (K, 3, 3), NaN where the sensor is no camera.
    """

    channels: NDArray[np.str_]
    translations: Array
    quaternions: Array
    intrinsics: Array


@dataclass(frozen=True)
class Samples:
    """N keyframes: tokens (N,), times_us (N,), world_from_ego (N, 3) and (N, 4) at LIDAR_TOP's time.

    lidars: (N,) LIDAR_TOP's place in Sensors. first_annotation: (N + 1,) where each one's annotations begin.
    """

    tokens: NDArray[np.bytes_]
    times_us: Ints
    translations: Array
    quaternions: Array
    lidars: Ints
    first_annotation: Ints


@dataclass(frozen=True)
class Images:
    """P camera images, by time in each scene; keyframes and those between.

    samples, sensors: (P,) places. times_us: (P,). keys: (P,) bool. sizes: (P, 2) width, height.
    translations (P, 3), quaternions (P, 4): world_from_ego at the image's time. files: (P,) below the root.
    """

    samples: Ints
    sensors: Ints
    times_us: Ints
    keys: NDArray[np.bool_]
    sizes: Ints
    translations: Array
    quaternions: Array
    files: NDArray[np.bytes_]


@dataclass(frozen=True)
class Annotations:
    """A boxes in the world, by sample. categories, attributes ("" none), instances: (A,) names and tokens.

    centers (A, 3), sizes_wlh (A, 3), quaternions (A, 4), velocities (A, 2) NaN unknown, visibilities (A,) 0 to 1,
    num_points (A,): lidar and radar.
    """

    categories: NDArray[np.bytes_]
    attributes: NDArray[np.bytes_]
    instances: NDArray[np.bytes_]
    centers: Array
    sizes_wlh: Array
    quaternions: Array
    velocities: Array
    visibilities: Array
    num_points: Ints


@dataclass(frozen=True)
class NuScenesIndex:
    """One version of nuScenes. Without annotations (the test split) their table has no rows."""

    scenes: Scenes
    sensors: Sensors
    samples: Samples
    images: Images
    annotations: Annotations

    def ground_truth(self, sample: int) -> Boxes3D | None:
        """A keyframe's boxes of the ten classes, in the world; None in a version without annotations."""
        if not len(self.annotations.categories):
            return None
        rows = self._annotations_of(sample)
        classes = [CLASS_OF_CATEGORY.get(name.decode()) for name in self.annotations.categories[rows]]
        kept = np.array([name is not None for name in classes], dtype=bool)
        return self._boxes(rows[kept], [name for name in classes if name])

    def bicycle_racks(self, sample: int) -> Boxes3D:
        """A keyframe's bicycle racks, in the world; the official evaluation leaves out bicycles inside them.

        Their class is nuScenes' category, as they are none of the ten.
        """
        rows = self._annotations_of(sample)
        racks = rows[self.annotations.categories[rows] == BICYCLE_RACK.encode()]
        return self._boxes(racks, [BICYCLE_RACK] * len(racks))

    def _annotations_of(self, sample: int) -> Ints:
        first = self.samples.first_annotation
        return np.arange(first[sample], first[sample + 1])

    def _boxes(self, rows: Ints, classes: list[str]) -> Boxes3D:
        a = self.annotations
        rotations = [rotation_from_quaternion(q) for q in a.quaternions[rows]]
        return Boxes3D(
            centers=np.array(a.centers[rows]),
            sizes_lwh=np.array(a.sizes_wlh[rows][:, [1, 0, 2]]),
            yaws=np.array([yaw_of_rotation(rotation) for rotation in rotations], dtype=np.float64),
            velocities=np.array(a.velocities[rows]),
            classes=np.array(classes, dtype=np.str_),
            attributes=a.attributes[rows].astype(np.str_),
            instances=a.instances[rows].astype(np.str_),
            visibilities=np.array(a.visibilities[rows]),
            num_points=np.array(a.num_points[rows]),
        )
