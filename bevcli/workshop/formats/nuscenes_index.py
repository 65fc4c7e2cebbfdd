"""The contents of nuScenes' tables as arrays ordered by scene and time: dialects, splits, keyframes and sweeps."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.ego_motion import nearest
from bevcli.geometry.transforms import Array, rotation_from_quaternion, yaw_of_rotation
from bevcli.workshop.formats import versions_in

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
# Scene numbers of the official splits, as published on nuscenes.org. All other scenes are in train and mini_train.
VAL = (
    "3 12-18 35-36 38-39 92-110 221 268-278 329-332 344-346 519-524 552-565 625-627 629-630 632-638 770-771 775 "
    "777-778 780-784 794-800 802 904-917 919-931 962-963 966-969 971-972 1059-1073"
)
TEST = (
    "77-91 111-119 140 142-148 265-266 279-282 307-314 333-343 481-498 547-551 601-604 606-624 827-831 833-842 "
    "844-846 932-933 935-943 1026-1043"
)
MINI_VAL = "103 916"
SPLITS = ("train", "val", "test", "mini_train", "mini_val")
LEADING_CAMERA = "CAM_FRONT"
# The cameras run at 12 Hz, triggered by the lidar's rotation. An image further away belongs to another rotation.
NEAR_US = 60_000


@dataclass(frozen=True)
class Dialect:
    """The reading of tables that differ from nuScenes' own in some points."""

    lidars: tuple[str, ...]  # channels of which each sample should have a keyframe, whose ego pose is that of the frame
    class_of: Callable[[str], str | None]  # a category -> its class, None for a category that is left out
    # names of visibility levels -> visible fraction, besides names such as "v40-60"
    visibilities: Mapping[str, float] = field(default_factory=dict)
    has_attributes: bool = True  # whether the attributes are those of nuScenes, which are scored
    bev_is_lidar: bool = True  # whether the bev frame is that of the lidar


# The published models predict in the frame of LIDAR_TOP.
NUSCENES = Dialect(("LIDAR_TOP",), CLASS_OF_CATEGORY.get)


@dataclass(frozen=True)
class Scenes:
    """S scenes."""

    names: NDArray[np.str_]  # (S,) such as "scene-0103"
    first_sample: Ints  # (S + 1,) row of each scene's first sample
    first_image: Ints  # (S + 1,) row of each scene's first image


@dataclass(frozen=True)
class Sensors:
    """K calibrated sensors."""

    channels: NDArray[np.str_]  # (K,) such as "CAM_FRONT"
    translations: Array  # (K, 3) of ego_from_sensor, metres
    quaternions: Array  # (K, 4) of ego_from_sensor, w, x, y, z
    intrinsics: Array  # (K, 3, 3) pixels; NaN for other sensors than cameras
    distortions: Array  # (K, 8) Brown-Conrady coefficients k1 k2 p1 p2 k3 k4 k5 k6; 0 without distortion


@dataclass(frozen=True)
class Samples:
    """N samples, nuScenes' word for keyframes."""

    tokens: NDArray[np.bytes_]  # (N,) nuScenes' identifiers
    times_us: Ints  # (N,) microseconds
    # of world_from_ego at the time of LIDAR_TOP, or of the nearest image where there is none
    translations: Array  # (N, 3) metres
    quaternions: Array  # (N, 4) w, x, y, z
    lidars: Ints  # (N,) row of the sample's LIDAR_TOP in Sensors, -1 where there is none
    first_annotation: Ints  # (N + 1,) row of each sample's first annotation


@dataclass(frozen=True)
class Images:
    """P camera images, those of keyframes and those between, by time within each scene."""

    samples: Ints  # (P,) row in Samples
    sensors: Ints  # (P,) row in Sensors
    times_us: Ints  # (P,) microseconds
    keys: NDArray[np.bool_]  # (P,) whether the image belongs to a keyframe
    sizes: Ints  # (P, 2) width and height, pixels
    translations: Array  # (P, 3) of world_from_ego at the image's time, metres
    quaternions: Array  # (P, 4) of world_from_ego, w, x, y, z
    files: NDArray[np.bytes_]  # (P,) paths relative to the dataset root


@dataclass(frozen=True)
class Annotations:
    """A annotated boxes in the world frame, ordered by sample."""

    # (A,) nuScenes' category names; "" for a box that refers to a missing instance and is left out
    categories: NDArray[np.bytes_]
    attributes: NDArray[np.bytes_]  # (A,) attribute names, "" for none
    instances: NDArray[np.bytes_]  # (A,) tokens of the objects
    centers: Array  # (A, 3) metres
    sizes_wlh: Array  # (A, 3) width, length, height, metres
    quaternions: Array  # (A, 4) w, x, y, z
    velocities: Array  # (A, 2) m/s along x and y; NaN if unknown
    visibilities: Array  # (A,) 0 to 1; NaN if unknown
    num_points: Ints  # (A,) number of lidar and radar points, -1 if unknown


@dataclass(frozen=True)
class NuScenesIndex:
    """One version of nuScenes. `annotations` has no rows if the version has none, as the test split."""

    scenes: Scenes
    sensors: Sensors
    samples: Samples
    images: Images
    annotations: Annotations

    def ground_truth(self, sample: int, dialect: Dialect = NUSCENES) -> Boxes3D | None:
        """A sample's boxes of the dialect's classes in the world frame; None in a version without annotations."""
        if not len(self.annotations.categories):
            return None
        rows = self._annotations_of(sample)
        classes = [dialect.class_of(name.decode()) if name else None for name in self.annotations.categories[rows]]
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


def tables_of(root: Path, version: str | None) -> Path:
    """The folder with a version's tables. Raises InputError if it is missing, or if the choice is not unique."""
    return root / choose_version(root, versions_in(root), version)


def choose_version(root: object, versions: Sequence[str], version: str | None) -> str:
    """The version with a name, or the only one. root: for messages. Raises InputError as `tables_of`."""
    matching = [name for name in versions if version in (None, name)]
    if len(matching) == 1:
        return matching[0]
    found = ", ".join(versions) or "none"
    problem = f'has no version "{version}"' if version else "has several versions"
    raise InputError(f"{root}: {problem} (found: {found}): choose one with `version` (`--version`)")


def chosen_scenes(index: NuScenesIndex, tables: Path, split: str | None, scene: str | None = None) -> list[int]:
    """Indices of the scenes with images of a split (None: all), or of one scene. Raises InputError without any."""
    names = [str(name) for name in index.scenes.names]
    if split is not None and split not in SPLITS:
        raise InputError(f'`split` (`--split`) "{split}": expected one of {", ".join(SPLITS)}')
    if scene is not None and scene not in names:
        few = ", ".join(names[:6]) + (f", ... ({len(names)} scenes)" if len(names) > 6 else "")
        raise InputError(f'{tables}: has no scene "{scene}" (found: {few})')
    mini = (split or "").startswith("mini")
    scenes = [
        number
        for number, name in enumerate(names)
        if scene in (None, name) and split in (None, split_of(name, mini=mini))
    ]
    if not scenes:
        what = f"scene {scene} is not in" if scene else "has no scene of"
        raise InputError(
            f"{tables}: {what} the split {split}: choose another `split` (`--split`) or `version` (`--version`)"
        )
    with_frames = (np.diff(index.scenes.first_sample) > 0) & (np.diff(index.scenes.first_image) > 0)
    filled = [number for number in scenes if with_frames[number]]
    if not filled:
        raise InputError(f"{tables / 'sample_data.json'}: scene {names[scenes[0]]} has no image of a camera")
    return filled


def split_of(scene: str, *, mini: bool) -> str:
    """The split of a scene such as "scene-0103"; "" for a name that does not belong to nuScenes.

    mini: whether to name the split of the mini version (mini_train, mini_val) instead of train, val or test.
    """
    number = scene.removeprefix("scene-")
    if not (number.isascii() and number.isdigit() and len(number) < 10):
        return ""
    if mini:
        return "mini_val" if int(number) in numbers(MINI_VAL) else "mini_train"
    if int(number) in numbers(VAL):
        return "val"
    return "test" if int(number) in numbers(TEST) else "train"


def numbers(ranges: str) -> frozenset[int]:
    """The numbers in ranges such as "3 12-18"."""
    values: set[int] = set()
    for item in ranges.split():
        first, _, last = item.partition("-")
        values |= set(range(int(first), int(last or first) + 1))
    return frozenset(values)


def keyframes(index: NuScenesIndex, scene: int) -> Iterator[tuple[int, int, Ints]]:
    """Time in us, sample and image rows of each keyframe of a scene."""
    first, last = index.scenes.first_image[scene : scene + 2]
    keys = first + np.flatnonzero(index.images.keys[first:last])
    samples = index.images.samples[keys]
    keys = keys[np.argsort(samples, kind="stable")]
    start, end = index.scenes.first_sample[scene : scene + 2]
    bounds = np.searchsorted(np.sort(samples), np.arange(start, end + 1))
    for position, sample in enumerate(range(start, end)):
        yield int(index.samples.times_us[sample]), sample, keys[bounds[position] : bounds[position + 1]]


def sweep_frames(index: NuScenesIndex, scene: int) -> Iterator[tuple[int, int | None, Ints]]:
    """Time in us, sample (None between keyframes) and image rows of every frame of a scene.

    There is one frame for each image of the front camera. A frame between keyframes follows its front image by the
    same delay as a keyframe, and has the image of each camera that is nearest in time.
    """
    first, last = index.scenes.first_image[scene : scene + 2]
    rows = np.arange(first, last)
    images = index.images
    cameras = index.sensors.channels[images.sensors[first:last]]
    names = sorted(set(cameras.tolist()))
    leading = rows[cameras == (LEADING_CAMERA if LEADING_CAMERA in names else names[0])]
    sample_times = index.samples.times_us[images.samples[leading]]
    keys = images.keys[leading]
    lag = int(np.median((sample_times - images.times_us[leading])[keys])) if keys.any() else 0
    by_camera = [rows[cameras == name] for name in names]
    key_rows = rows[images.keys[first:last]]
    time = -1
    for row, is_key in zip(leading, keys, strict=True):
        earlier, sample = time, int(images.samples[row])
        if is_key:
            time = int(index.samples.times_us[sample])
            image_rows = key_rows[images.samples[key_rows] == sample]
        else:
            time = int(images.times_us[row]) + lag
            image_rows = _nearest(index, by_camera, time)
        if time > earlier:
            yield time, sample if is_key else None, image_rows


def _nearest(index: NuScenesIndex, by_camera: list[Ints], time: int) -> Ints:
    """Rows of each camera's image nearest to a time in us, without images that are too far away."""
    times = index.images.times_us
    closest = np.array([rows[nearest(times[rows], time)] for rows in by_camera])
    return closest[np.abs(times[closest] - time) <= NEAR_US]
