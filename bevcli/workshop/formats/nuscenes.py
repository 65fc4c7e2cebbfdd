"""A nuScenes root or a T4 dataset as a drive, with the rig, the poses and the CAN bus data of each scene."""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.frame import Frame, FrameStamp
from bevcli.geometry.cameras import NUSCENES_YAWS_DEG, Camera, CameraRig, brown_conrady, default_ego_from_bev
from bevcli.geometry.ego_motion import EgoMotion, Kinematics
from bevcli.geometry.transforms import Array, Pose
from bevcli.parsing.files import is_there
from bevcli.sequences.files.calibration_file import checked_camera
from bevcli.sequences.format import Format
from bevcli.sequences.images import FrameEntry, ImageReader, ImageSource, ListedDrive, bev_frame_notes
from bevcli.sequences.options import InputOptions
from bevcli.workshop.formats import NuScenesOptions
from bevcli.workshop.formats.labels import names_of_format
from bevcli.workshop.formats.map_lines import MapExpansion
from bevcli.workshop.formats.nuscenes_index import (
    NUSCENES,
    Dialect,
    Images,
    Ints,
    NuScenesIndex,
    Samples,
    Sensors,
    chosen_scenes,
    keyframes,
    sweep_frames,
    tables_of,
)
from bevcli.workshop.formats.nuscenes_tables import open_index, read_rows
from bevcli.workshop.formats.poses import motion_of_keyframes

# The order of nuScenes' cameras in a rig. Other cameras follow, sorted by name.
CAMERAS = tuple(NUSCENES_YAWS_DEG)
# T4 datasets of TIER IV, as Autoware uses them: nuScenes' tables with additions.
T4_LIDARS = ("LIDAR_CONCAT", "LIDAR_TOP")
# The documented meaning: not occluded, by less than half, by more than half, and by 90 to 100 %.
T4_VISIBILITIES = {"full": 1.0, "most": 0.75, "partial": 0.3, "none": 0.05}

# Class names; docs/other-inputs.md says what is lost. Older datasets have the longer names. Names are compared without
# case; others stay as they are, and are not scored.
T4_CATEGORIES_OF_CLASS = {
    "car": ("vehicle.car", "police_car", "vehicle.police", "vehicle.emergency (ambulance & police)"),
    "truck": ("ambulance", "vehicle.ambulance", "fire_truck", "vehicle.fire", "vehicle.truck"),
    "construction_vehicle": ("forklift", "vehicle.construction"),
    "bus": ("vehicle.bus", "vehicle.bus (bendy & rigid)"),
    "trailer": ("vehicle.trailer", "semi_trailer"),
    "motorcycle": ("motorbike", "vehicle.motorbike", "vehicle.motorcycle"),
    "bicycle": ("vehicle.bicycle",),
    "pedestrian": (
        "construction_worker", "police_officer", "pedestrian.adult", "pedestrian.child",
        "pedestrian.construction_worker", "pedestrian.police_officer",
    ),
    "barrier": ("movable_object.barrier",),
    "traffic_cone": ("movable_object.trafficcone", "movable_object.traffic_cone"),
}  # fmt: skip
T4_CLASS_OF_CATEGORY = {name: class_name for class_name, names in T4_CATEGORIES_OF_CLASS.items() for name in names}


@dataclass(frozen=True)
class CanBus:
    """The T pose messages of a scene in the CAN bus expansion."""

    times_us: NDArray[np.int64]  # (T,) microseconds, increasing
    accelerations: Array  # (T, 3) m/s² with gravity, ego frame
    angular_rates: Array  # (T, 3) rad/s, ego frame
    velocities: Array  # (T, 3) m/s, ego frame

    def kinematics_at(self, timestamp_ns: int) -> Kinematics:
        """The first message after a time, or the last message. The published models were trained this way."""
        row = min(int(np.searchsorted(self.times_us, timestamp_ns // 1000, side="right")), len(self.times_us) - 1)
        return Kinematics(self.accelerations[row], self.angular_rates[row], self.velocities[row])


class _Place(NamedTuple):
    """A frame in the index: its scene, its sample (None for a sweep), and the rows of its images."""

    scene: int
    sample: int | None
    rows: Ints


class TableDrive(ListedDrive):
    """Frames of a folder with nuScenes' tables, scene after scene, numbered from 0.

    Args:
        root: the folder that file names are relative to.
        tables: the folder with the tables.
        common: the options of every format.
        dialect: the points in which the tables differ from nuScenes' own.
        own: only the scenes of its split; whether images between the keyframes make frames too.

    Raises InputError if a table is missing or invalid, or the choice contains no scene.
    """

    has_ego_motion = True

    def __init__(self, root: Path, tables: Path, common: InputOptions, dialect: Dialect, own: NuScenesOptions) -> None:
        common.refuse_static(root)
        self.name = root.resolve().name
        self.path, self.tables, self.dialect = root, tables, dialect
        self.index, note = open_index(tables, dialect)
        self.scenes = chosen_scenes(self.index, tables, own.split, common.scene)
        self.rig = scene_rig(self.index, dialect, self.scenes[0], tables)
        find = sweep_frames if own.sweeps else keyframes
        found = [(scene, *frame) for scene in self.scenes for frame in find(self.index, scene)]
        names = [str(name) for name in self.index.scenes.names]
        times = [(names[scene], time_us * 1000) for scene, time_us, _, _ in found]
        self.stamps = tuple(FrameStamp(number, *time) for number, time in enumerate(times))
        self._places = tuple(_Place(scene, sample, rows) for scene, _, sample, rows in found)
        self._truth = {}
        self._images = ImageReader(strict=common.strict, inside=None if common.allow_outside else root)
        self._scene = lru_cache(maxsize=2)(self._read_scene)
        self.notes = (*((note,) if note else ()), *bev_frame_notes(self.rig, str(tables)), *self._table_notes())

    def _table_notes(self) -> Iterator[str]:
        samples = self.index.samples
        spans = [self.index.scenes.first_sample[scene : scene + 2] for scene in self.scenes]
        lidars = np.concatenate([samples.lidars[slice(*span)] for span in spans])
        if (lidars < 0).any():
            yield (
                f"{self.tables / 'sample_data.json'}: {(lidars < 0).sum()} of {len(lidars)} samples have no keyframe "
                f"of {' or '.join(self.dialect.lidars)}: their pose is that of the image nearest in time"
            )
        of_spans = [slice(*samples.first_annotation[span]) for span in spans]
        names = np.concatenate([self.index.annotations.categories[span] for span in of_spans])
        if (names == b"").any():
            source = f"{self.tables / 'sample_annotation.json'}: {(names == b'').sum()} of {len(names)}"
            yield f"{source} boxes are left out: instance.json lacks their instance"

    @property
    def input_files(self) -> tuple[Path, ...]:
        return tuple(sorted(self.tables.glob("*.json")))

    @property
    def class_counts(self) -> Mapping[str, int]:
        first, categories = self.index.samples.first_annotation, self.index.annotations.categories
        by_category: Counter[bytes] = Counter()
        for sample in (place.sample for place in self._places if place.sample is not None):
            by_category.update(categories[first[sample] : first[sample + 1]].tolist())
        counts: Counter[str] = Counter()
        for category, count in by_category.items():
            if category and (name := self.dialect.class_of(category.decode())):
                counts[name] += count
        return counts

    def _entry(self, index: int) -> FrameEntry:
        """The frame and its images: those of all frames would fill the memory."""
        rig, images, rows = self._scene(self._places[index].scene)[0], self.index.images, self._places[index].rows
        found = {
            str(name): ImageSource(self.path / images.files[row].decode(), int(images.times_us[row]) * 1000)
            for name, row in zip(self.index.sensors.channels[images.sensors[rows]], rows, strict=True)
        }
        sources = {name: found[name] for name in rig.names if name in found}
        dropped = {name: "no image in sample_data.json" for name in rig.names if name not in found}
        return FrameEntry(self.stamps[index], sources, dropped, str(self.tables))

    def _rig_and_motion(self, index: int) -> tuple[CameraRig, EgoMotion]:
        return self._scene(self._places[index].scene)[:2]

    def _frame(self, index: int, entry: FrameEntry) -> Frame:
        frame, place = super()._frame(index, entry), self._places[index]
        can_bus = self._scene(place.scene)[2]
        if can_bus is not None:
            frame = replace(frame, kinematics=can_bus.kinematics_at(entry.stamp.timestamp_ns))
        if place.sample is None:
            return frame
        truth = self.index.ground_truth(place.sample, self.dialect)
        return replace(frame, ground_truth=truth, sample_token=self.index.samples.tokens[place.sample].decode())

    def _read_scene(self, scene: int) -> tuple[CameraRig, EgoMotion, CanBus | None]:
        """Rig, poses and CAN bus of a scene, by its row in the index."""
        rig, motion = scene_rig(self.index, self.dialect, scene, self.tables), scene_motion(self.index, scene)
        return rig, motion, read_can_bus(self.path, str(self.index.scenes.names[scene]))


class NuScenesDrive(TableDrive):
    """Frames of a nuScenes root: keyframes, and sweeps if they are chosen.

    The bev frame is the scene's LIDAR_TOP frame. The world frame is that of nuScenes' map. Keyframes have true lines of
    the map where the root has the map expansion.
    Raises InputError as `TableDrive`.
    """

    def __init__(
        self, root: Path, common: InputOptions = InputOptions(), own: NuScenesOptions = NuScenesOptions()
    ) -> None:
        tables = tables_of(root, own.version)
        super().__init__(root, tables, common, NUSCENES, own)
        self.name = common.scene or own.split or tables.name
        expansion = root / "maps/expansion"
        self._true_lines = MapExpansion(expansion, tables) if common.ground_truth and is_there(expansion) else None
        note = self._can_bus_note()
        self.notes = (*self.notes, note) if note else self.notes

    def _frame(self, index: int, entry: FrameEntry) -> Frame:
        frame = super()._frame(index, entry)
        lines = self._true_lines(frame) if self._true_lines and self._places[index].sample is not None else None
        return frame if lines is None else replace(frame, ground_truth_results=(lines,))

    def _can_bus_note(self) -> str:
        names = [str(self.index.scenes.names[scene]) for scene in self.scenes]
        without = [name for name in names if not (self.path / "can_bus" / f"{name}_pose.json").is_file()]
        if not without:
            return ""
        which = without[0] if len(without) == 1 else f"{len(without)} of {len(names)} scenes"
        return f"{which}: no CAN bus data in {self.path / 'can_bus'}; kinematics are derived from the poses"


def _pose_of(table: Images | Samples | Sensors, row: int) -> Pose:
    return Pose(np.array(table.translations[row]), np.array(table.quaternions[row]))


def scene_rig(index: NuScenesIndex, dialect: Dialect, scene: int, tables: Path) -> CameraRig:
    """The rig of a scene. tables: for messages. Raises InputError."""
    first, last = index.scenes.first_image[scene : scene + 2]
    sensors, rows = np.unique(index.images.sensors[first:last], return_index=True)
    cameras = [_camera(index, int(sensor), first + row, tables) for sensor, row in zip(sensors, rows, strict=True)]
    cameras.sort(key=lambda camera: (CAMERAS.index(camera.name) if camera.name in CAMERAS else 99, camera.name))
    if len({camera.name for camera in cameras}) < len(cameras):
        raise InputError(f"scene {index.scenes.names[scene]}: a camera changes its calibration within the scene")
    lidars = index.samples.lidars[slice(*index.scenes.first_sample[scene : scene + 2])]
    lidar = next((int(lidar_row) for lidar_row in lidars if lidar_row >= 0), None)
    if lidar is None or not dialect.bev_is_lidar:
        return CameraRig(tuple(cameras), default_ego_from_bev(), ego_from_bev_assumed=True)
    return CameraRig(tuple(cameras), _pose_of(index.sensors, lidar).matrix)


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


def _camera(index: NuScenesIndex, sensor: int, image: int, tables: Path) -> Camera:
    width, height = (int(value) for value in index.images.sizes[image])
    intrinsics, lens = np.array(index.sensors.intrinsics[sensor]), brown_conrady(index.sensors.distortions[sensor])
    source = f"{tables}: sample_data.json and calibrated_sensor.json"
    ego_from_camera, name = _pose_of(index.sensors, sensor).matrix, str(index.sensors.channels[sensor])
    return checked_camera(Camera(name, width, height, intrinsics, ego_from_camera, lens), source)


def open_t4(path: Path, common: InputOptions, options: Format) -> TableDrive:
    """The keyframes of a T4 dataset.

    The ego frame is Autoware's base_link: below the rear axle, on the ground. The bev frame is the default, because the
    lidar's axes differ from those of nuScenes' LIDAR_TOP. Raises InputError as `TableDrive`.
    """
    names = names_of_format(T4_CLASS_OF_CATEGORY, common.class_map)
    dialect = Dialect(T4_LIDARS, names.__getitem__, T4_VISIBILITIES, has_attributes=False, bev_is_lidar=False)
    return TableDrive(path, path / "annotation", common, dialect, NuScenesOptions())
