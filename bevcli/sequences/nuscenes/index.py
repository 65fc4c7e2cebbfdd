"""The contents of nuScenes' tables that bevcli needs, as arrays ordered by scene and time, and dialects of them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array, rotation_from_quaternion, yaw_of_rotation

Ints = NDArray[np.int64]

# From nuScenes' categories to the ten detection classes. Other categories are not detected.
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
class Dialect:
    """The reading of tables that differ from nuScenes' own in some points.

    Attributes:
        lidars: channels of which each sample should have a keyframe, whose ego pose is that of the frame.
        class_of: a category -> its class, None for a category that is left out.
        visibilities: names of visibility levels -> visible fraction, besides names such as "v40-60".
        has_attributes: whether the attributes are those of nuScenes, which are scored.
        bev_is_lidar: whether the bev frame is that of the lidar.
    """

    lidars: tuple[str, ...]
    class_of: Callable[[str], str | None]
    visibilities: Mapping[str, float] = field(default_factory=dict)
    has_attributes: bool = True
    bev_is_lidar: bool = True


# The published models predict in the frame of LIDAR_TOP.
NUSCENES = Dialect(("LIDAR_TOP",), CLASS_OF_CATEGORY.get)


@dataclass(frozen=True)
class Scenes:
    """S scenes.

    Attributes:
        names: (S,) such as "scene-0103".
        first_sample: (S + 1,) row of each scene's first sample.
        first_image: (S + 1,) row of each scene's first image.
    """

    names: NDArray[np.str_]
    first_sample: Ints
    first_image: Ints


@dataclass(frozen=True)
class Sensors:
    """K calibrated sensors.

    Attributes:
        channels: (K,) such as "CAM_FRONT".
        translations, quaternions: (K, 3) metres and (K, 4) w, x, y, z of ego_from_sensor.
        intrinsics: (K, 3, 3) pixels; NaN for other sensors than cameras.
        distortions: (K, 8) Brown-Conrady coefficients k1 k2 p1 p2 k3 k4 k5 k6; 0 without distortion.
    """

    channels: NDArray[np.str_]
    translations: Array
    quaternions: Array
    intrinsics: Array
    distortions: Array


@dataclass(frozen=True)
class Samples:
    """N samples, nuScenes' word for keyframes.

    Attributes:
        tokens: (N,) nuScenes' identifiers.
        times_us: (N,) microseconds.
        translations, quaternions: (N, 3) metres and (N, 4) w, x, y, z of world_from_ego at the time of LIDAR_TOP,
            or of the nearest image where there is none.
        lidars: (N,) row of the sample's LIDAR_TOP in Sensors, -1 where there is none.
        first_annotation: (N + 1,) row of each sample's first annotation.
    """

    tokens: NDArray[np.bytes_]
    times_us: Ints
    translations: Array
    quaternions: Array
    lidars: Ints
    first_annotation: Ints


@dataclass(frozen=True)
class Images:
    """P camera images, those of keyframes and those between, by time within each scene.

    Attributes:
        samples: (P,) row in Samples.
        sensors: (P,) row in Sensors.
        times_us: (P,) microseconds.
        keys: (P,) bool, whether the image belongs to a keyframe.
        sizes: (P, 2) width and height, pixels.
        translations, quaternions: (P, 3) metres and (P, 4) w, x, y, z of world_from_ego at the image's time.
        files: (P,) paths relative to the dataset root.
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
    """A annotated boxes in the world frame, ordered by sample.

    Attributes:
        categories: (A,) nuScenes' category names; "" for a box that refers to a missing instance and is left out.
        attributes: (A,) attribute names, "" for none.
        instances: (A,) tokens of the objects.
        centers: (A, 3) metres.
        sizes_wlh: (A, 3) width, length, height, metres.
        quaternions: (A, 4) w, x, y, z.
        velocities: (A, 2) m/s along x and y; NaN if unknown.
        visibilities: (A,) 0 to 1; NaN if unknown.
        num_points: (A,) number of lidar and radar points, -1 if unknown.
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
    """One version of nuScenes. `annotations` has no rows if the version has none, as the test split."""

    scenes: Scenes
    sensors: Sensors
    samples: Samples
    images: Images
    annotations: Annotations

    def ground_truth(
        self, sample: int, class_of: Callable[[str], str | None] = CLASS_OF_CATEGORY.get
    ) -> Boxes3D | None:
        """A sample's boxes in the world frame; None in a version without annotations.

        class_of: a category -> its class, None for a category that is left out.
        """
        if not len(self.annotations.categories):
            return None
        rows = self._annotations_of(sample)
        classes = [class_of(name.decode()) if name else None for name in self.annotations.categories[rows]]
        kept = np.array([bool(name) for name in classes], dtype=bool)
        return self._boxes(rows[kept], [name for name in classes if name])

    def bicycle_racks(self, sample: int) -> Boxes3D:
        """A sample's bicycle racks in the world frame. The official evaluation ignores bicycles inside them.

        Their class name is nuScenes' category, because they belong to none of the ten classes.
        """
        rows = self._annotations_of(sample)
        racks = rows[self.annotations.categories[rows] == BICYCLE_RACK.encode()]
        return self._boxes(racks, [BICYCLE_RACK] * len(racks))

    def _annotations_of(self, sample: int) -> Ints:
        first = self.samples.first_annotation
        return np.arange(first[sample], first[sample + 1])

    def _boxes(self, rows: Ints, classes: list[str]) -> Boxes3D:
        a = self.annotations
        return Boxes3D(
            centers=np.array(a.centers[rows]),
            sizes_lwh=np.array(a.sizes_wlh[rows][:, [1, 0, 2]]),
            yaws=np.array(
                [yaw_of_rotation(rotation_from_quaternion(q)) for q in a.quaternions[rows]], dtype=np.float64
            ),
            velocities=np.array(a.velocities[rows]),
            classes=np.array(classes, dtype=np.str_),
            attributes=a.attributes[rows].astype(np.str_),
            instances=a.instances[rows].astype(np.str_),
            visibilities=np.array(a.visibilities[rows]),
            num_points=np.array(a.num_points[rows]),
        )
