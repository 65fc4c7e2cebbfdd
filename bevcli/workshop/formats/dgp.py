"""A DGP scene as a drive: its samples with images and point clouds, each with a pose, calibrations, 3D boxes."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import cache, partial
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from bevcli.errors import InputError
from bevcli.frame import FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import Camera, CameraRig, brown_conrady, default_ego_from_bev
from bevcli.geometry.ego_motion import PoseTable, motion_of_keyframes
from bevcli.geometry.transforms import Array, Pose, inverse, yaw_of_rotation
from bevcli.parsing.documents import LARGEST_INTEGER, read_json
from bevcli.sequences.files.boxes_file import ClassNames
from bevcli.sequences.files.calibration_file import checked_camera
from bevcli.sequences.format import Format
from bevcli.sequences.images import FrameEntry, ImageSource, ListedDrive, bev_frame_notes, leads_out
from bevcli.sequences.options import InputOptions
from bevcli.workshop.formats.labels import with_track_velocities

# DDAD's class names; docs/other-inputs.md says what is lost. Names are compared without case; others, such as Wheeled
# Slow and Train, stay as they are, and are not scored.
CLASS_OF_CATEGORY = {
    "Person": "pedestrian",
    "Pedestrian": "pedestrian",
    "Bus/RV/Caravan": "bus",
    "Towed Object": "trailer",
    "Caravan/RV": "truck",
}
LARGEST_NUMBER = 1e12  # metres or pixels
SHORTEST_QUATERNION = 1e-3
EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
PINHOLE = ("fx", "fy", "cx", "cy")
BROWN_CONRADY = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
OTHER_LENSES = ("fisheye", "s1", "s2", "s3", "s4", "taux", "tauy", "alpha", "beta", "w", "xi", "equirectangular")
TENFOLD = "the times of the scene are after the year 2116: they are taken as ten times too large, as in DDAD"
BOXES_3D = "1"  # the number of 3D boxes among DGP's kinds of annotations
SIZE = ("length", "width", "height")
FileOf = Callable[["Record", str], Path]  # the file that a member of an object names


class Record:
    """A JSON object of a file, whose members are checked when they are asked for. Errors name file and member.

    value: the object. where: the file and the place in it, for messages. Raises InputError if it is no object.
    """

    def __init__(self, value: Any, where: str) -> None:
        if not isinstance(value, dict):
            raise InputError(f"{where}: expected an object, found {type(value).__name__}")
        self.value: Mapping[str, Any] = value
        self.where = where

    def record(self, name: str) -> "Record":
        """A member that is an object. Raises InputError."""
        return Record(self._member(name), f"{self.where}: {name}")

    def records(self, name: str) -> list["Record"]:
        """A member that is a list of objects. Raises InputError."""
        value = self._member(name)
        if not isinstance(value, list):
            raise InputError(f'{self.where}: "{name}": expected a list, found {type(value).__name__}')
        return [Record(member, f"{self.where}: {name}[{index}]") for index, member in enumerate(value)]

    def text(self, name: str) -> str:
        """A member that is a text of at most 400 characters. Raises InputError."""
        value = self._member(name)
        if not isinstance(value, str) or not 0 < len(value) <= 400:
            raise InputError(f'{self.where}: "{name}": expected a text of at most 400 characters')
        return value

    def texts(self, name: str) -> list[str]:
        """A member that is a list of texts. Raises InputError."""
        value = self._member(name)
        if not isinstance(value, list) or not all(isinstance(text, str) for text in value):
            raise InputError(f'{self.where}: "{name}": expected a list of texts')
        return value

    def numbers(self, names: tuple[str, ...], default: float | None = None) -> Array:
        """(N,) members that are finite numbers. A missing one is `default`; with None it raises InputError."""
        values = [self._member(name) if default is None or name in self.value else default for name in names]
        if any(type(value) not in (int, float) or not abs(value) < LARGEST_NUMBER for value in values):
            raise InputError(f"{self.where}: expected finite numbers {', '.join(names)}, found {values!r:.80}")
        return np.array(values, dtype=np.float64)

    def integer(self, name: str, default: int | None = None) -> int:
        """A member that is an integer. Raises InputError as `numbers`."""
        value = self._member(name) if default is None or name in self.value else default
        if type(value) is not int:
            raise InputError(f'{self.where}: "{name}": expected an integer, found {value!r:.40}')
        return value

    def pose(self) -> Pose:
        """The pose of {"rotation": {"qw", ...}, "translation": {"x", ...}}. Raises InputError."""
        rotation = self.record("rotation").numbers(("qw", "qx", "qy", "qz"), 0.0)
        if not np.linalg.norm(rotation) > SHORTEST_QUATERNION:
            raise InputError(f"{self.where}: expected a quaternion of norm 1, found norm 0")
        return Pose(self.record("translation").numbers(("x", "y", "z"), 0.0), rotation / np.linalg.norm(rotation))

    def timestamp(self) -> datetime:
        """The time of {"timestamp": "2019-05-03T21:39:53.820375Z"}. Raises InputError."""
        text = self.text("timestamp")
        try:
            time = datetime.fromisoformat(text)
        except ValueError:
            raise InputError(
                f'{self.where}: "timestamp": expected such as 2019-05-03T21:39:53Z, found "{text:.40}"'
            ) from None
        return time if time.tzinfo else time.replace(tzinfo=UTC)

    def _member(self, name: str) -> Any:
        if name not in self.value:
            raise InputError(f'{self.where}: "{name}" is missing')
        return self.value[name]


def read_record(path: Path) -> Record:
    """The object in a JSON file. Raises InputError."""
    return Record(read_json(path), str(path))


def _nanoseconds(times: list[datetime], where: str) -> tuple[list[int], bool]:
    """The times since 1970 in ns, and whether they were divided by ten. Raises InputError beyond any year.

    DDAD's files state tenths of microseconds as microseconds: a drive of 2019 seems to be of the year 2463, with one
    frame per second in place of ten. where: start of a message.
    """
    times_ns = [(time - EPOCH) // timedelta(microseconds=1) * 1000 for time in times]
    tenfold = max(times_ns) > LARGEST_INTEGER
    times_ns = [time // 10 for time in times_ns] if tenfold else times_ns
    if not 0 <= min(times_ns) <= max(times_ns) <= LARGEST_INTEGER:
        raise InputError(
            f"{where}: the times {min(times)} to {max(times)} are impossible (expected years from 1970 on)"
        )
    return times_ns, tenfold


@dataclass(frozen=True)
class Calibration:
    """The poses of all sensors, and the lenses of the cameras among them, by sensor."""

    ego_from: Mapping[str, Pose]
    lenses: Mapping[str, Record]

    def camera(self, name: str, size: tuple[int, int]) -> Camera:
        """A camera with the size of its image (width, height). Raises InputError."""
        lens = self.lenses[name]
        fx, fy, cx, cy = lens.numbers(PINHOLE)
        for other in OTHER_LENSES:
            if lens.numbers((other,), 0.0).any():
                raise InputError(
                    f'{lens.where}: camera {name}: the lens has "{other}", which is not supported (expected a pinhole '
                    f"camera with {', '.join(BROWN_CONRADY)}): undistort the images"
                )
        (skew,) = lens.numbers(("skew",), 0.0)
        intrinsics = np.array([[fx, skew, cx], [0, fy, cy], [0, 0, 1]])
        distortion = brown_conrady(lens.numbers(BROWN_CONRADY, 0.0))
        return checked_camera(Camera(name, *size, intrinsics, self.ego_from[name].matrix, distortion), lens.where)


def _read_calibration(path: Path) -> Calibration:
    record = read_record(path)
    names, lenses, poses = record.texts("names"), record.records("intrinsics"), record.records("extrinsics")
    if not len(names) == len(set(names)) == len(lenses) == len(poses):
        raise InputError(f"{path}: expected as many names as intrinsics and extrinsics, each name once")
    return Calibration(
        dict(zip(names, (pose.pose() for pose in poses), strict=True)), dict(zip(names, lenses, strict=True))
    )


@dataclass(frozen=True)
class Datum:
    """One image or point cloud, with the pose at its own time. content: the object "image" or "point_cloud"."""

    sensor: str
    is_image: bool
    content: Record
    time_ns: int
    world_from_sensor: Pose


@dataclass(frozen=True)
class Sample:
    """The images and point clouds of one moment, at least one. calibration: of their sensors."""

    time_ns: int
    data: tuple[Datum, ...]
    calibration: Calibration

    def ego_pose(self, datum: Datum) -> Pose:
        """world_from_ego at the time of one of its data."""
        return Pose.from_matrix(
            datum.world_from_sensor.matrix @ inverse(self.calibration.ego_from[datum.sensor].matrix)
        )

    def images(self) -> dict[str, Record]:
        """The content of each camera's image."""
        return {datum.sensor: datum.content for datum in self.data if datum.is_image}

    def rig(self, others: Mapping[str, Record]) -> CameraRig:
        """The cameras in the order of the calibration. others: their images elsewhere, for sizes. Raises InputError."""
        images = {**others, **self.images()}
        if unknown := [name for name in images if name not in self.calibration.ego_from]:
            raise InputError(f'{images[unknown[0]].where}: a calibration has no sensor "{unknown[0]}"')
        names = [name for name in self.calibration.ego_from if name in images]
        sizes = [(images[name].integer("width"), images[name].integer("height")) for name in names]
        cameras = tuple(map(self.calibration.camera, names, sizes))
        return CameraRig(cameras, default_ego_from_bev(), ego_from_bev_assumed=True)


def _read_samples(path: Path, scene: Record) -> tuple[tuple[Sample, ...], bool]:
    """The samples in order of time, and whether the times were divided by ten, see `_nanoseconds`. Raises InputError.

    path: the folder of the scene. scene: the contents of its file.
    """
    records = {record.text("key"): record for record in scene.records("data")}
    samples = sorted(scene.records("samples"), key=lambda sample: sample.record("id").timestamp())
    if not samples:
        raise InputError(f"{scene.where}: has no samples (expected at least one)")
    owners = [*records.values(), *samples]
    times, tenfold = _nanoseconds([owner.record("id").timestamp() for owner in owners], scene.where)
    data = {key: _datum(record, time) for (key, record), time in zip(records.items(), times, strict=False)}
    calibration_of = cache(lambda key: _read_calibration(path / "calibration" / f"{key}.json"))
    samples_with_data = []
    for sample, time in zip(samples, times[len(records) :], strict=True):
        calibration = calibration_of(sample.text("calibration_key"))
        samples_with_data.append(Sample(time, _data_of(sample, data, calibration), calibration))
    if any(later.time_ns <= earlier.time_ns for earlier, later in pairwise(samples_with_data)):
        raise InputError(f"{scene.where}: two samples have the same time (expected increasing times)")
    return tuple(samples_with_data), tenfold


def _data_of(sample: Record, data: dict[str, Datum | None], calibration: Calibration) -> tuple[Datum, ...]:
    data_of_sample = []
    for key in sample.texts("datum_keys"):
        if key not in data:
            raise InputError(f'{sample.where}: datum "{key:.40}" is missing in "data"')
        datum = data[key]
        if datum is None:
            continue
        if datum.sensor not in calibration.ego_from:
            raise InputError(f'{sample.where}: its calibration has no sensor "{datum.sensor}"')
        data_of_sample.append(datum)
    if not data_of_sample:
        raise InputError(f"{sample.where}: has no image and no point cloud (expected at least one)")
    return tuple(data_of_sample)


def _datum(record: Record, time_ns: int) -> Datum | None:
    contents = record.record("datum")
    datum_type = next((name for name in ("image", "point_cloud") if name in contents.value), None)
    if datum_type is None:
        return None
    content = contents.record(datum_type)
    pose = content.record("pose").pose()
    return Datum(record.record("id").text("name"), datum_type == "image", content, time_ns, pose)


def _poses(samples: Iterable[Sample], *, keys: bool) -> PoseTable:
    """The poses at the times of all data; or only the one of each sample that is nearest to its time, at that time."""
    rows = []
    for sample in samples:
        nearest = min(sample.data, key=lambda datum: abs(datum.time_ns - sample.time_ns))
        data = [(sample.time_ns, nearest)] if keys else [(datum.time_ns, datum) for datum in sample.data]
        rows += [(time, sample.ego_pose(datum)) for time, datum in data]
    times = np.array([time for time, _ in rows], dtype=np.int64)
    return times, np.stack([pose.translation for _, pose in rows]), np.stack([pose.quaternion for _, pose in rows])


def open_scene(path: Path, common: InputOptions, options: Format) -> ListedDrive:
    """The samples of a DGP scene. Point clouds are not read, only the boxes that are annotated in them.

    The ego frame is DDAD's: below the rear axle, on the ground. Raises InputError.
    """
    common.refuse_static(path)
    scene = read_record(_scene_file(path))
    samples, tenfold = _read_samples(path, scene)
    images = {name: image for sample in samples for name, image in sample.images().items()}
    if not images:
        raise InputError(f"{scene.where}: no sample has an image (expected at least one)")
    rigs = tuple(sample.rig(images) for sample in samples)
    file_of = partial(_file, path, allow_outside=common.allow_outside)
    entries = tuple(_entry(path, index, sample, rigs[0], file_of) for index, sample in enumerate(samples))
    motion = motion_of_keyframes(_poses(samples, keys=True), _poses(samples, keys=False))
    truth = _read_truth(path, scene, samples, common.class_map, file_of) if common.ground_truth else {}
    notes = (*bev_frame_notes(rigs[0], "a DGP scene"), *((TENFOLD,) if tenfold else ()))
    files = tuple(sorted((*path.glob("scene_*.json"), *path.glob("calibration/*.json"))))
    return ListedDrive(path, common, rigs, entries, motion, truth, notes, files)


def _entry(path: Path, index: int, sample: Sample, rig: CameraRig, file_of: FileOf) -> FrameEntry:
    sources = {
        datum.sensor: ImageSource(file_of(datum.content, "filename"), datum.time_ns)
        for datum in sample.data
        if datum.is_image
    }
    dropped = {name: "no image in the sample" for name in rig.names if name not in sources}
    return FrameEntry(FrameStamp(index, "", sample.time_ns), sources, dropped, str(path))


def _file(path: Path, record: Record, member: str, *, allow_outside: bool) -> Path:
    name = record.text(member)
    file = path / PurePosixPath(name)
    if not allow_outside and leads_out(file, path):
        where = f"{record.where}: {name:.100}"
        raise InputError(f"{where}: leads out of the folder: pass `allow_outside=True` (`--allow-outside`) to read it")
    return file


def _read_truth(
    path: Path, scene: Record, samples: Iterable[Sample], class_map: Mapping[str, str], file_of: FileOf
) -> dict[int, Boxes3D]:
    """The boxes in the world frame of each sample that has a point cloud with boxes."""
    boxes_of, times = {}, []
    classes: dict[int, str] | None = None
    for index, sample in enumerate(samples):
        for cloud in (datum for datum in sample.data if not datum.is_image):
            annotations = cloud.content.record("annotations")
            if BOXES_3D in annotations.value:
                classes = _read_ontology(path, scene, class_map) if classes is None else classes
                boxes_file = file_of(annotations, BOXES_3D)
                boxes_of[index] = _read_boxes(boxes_file, cloud.world_from_sensor.matrix, classes)
                times.append(sample.time_ns)
                break
    return dict(zip(boxes_of, with_track_velocities(list(boxes_of.values()), times), strict=True))


def _scene_file(path: Path) -> Path:
    files = sorted(path.glob("scene_*.json"))
    if len(files) == 1:
        return files[0]
    names = ", ".join(file.name for file in files[:4]) or "none"
    raise InputError(f"{path}: expected one file scene_*.json, found {names}")


def _read_ontology(folder: Path, scene: Record, class_map: Mapping[str, str]) -> dict[int, str]:
    names = ClassNames.of_format(CLASS_OF_CATEGORY, class_map)
    items = read_record(folder / "ontology" / f"{scene.record('ontologies').text(BOXES_3D)}.json").records("items")
    return {item.integer("id", 0): names[item.text("name")] for item in items}


def _read_boxes(path: Path, world_from_sensor: Array, classes: Mapping[int, str]) -> Boxes3D:
    records = read_record(path).records("annotations")
    if not records:
        return Boxes3D.empty()
    boxes = [record.record("box") for record in records]
    world_from_box = [world_from_sensor @ box.record("pose").pose().matrix for box in boxes]
    ids = [record.integer("class_id", 0) for record in records]
    things = [record.integer("instance_id", 0) for record in records]  # 0 is that of a box without one
    return Boxes3D(
        np.stack([pose[:3, 3] for pose in world_from_box]),
        np.stack([box.numbers(SIZE) for box in boxes]),
        np.array([yaw_of_rotation(pose[:3, :3]) for pose in world_from_box]),
        np.full((len(boxes), 2), np.nan),
        np.array([classes.get(number, f"class {number}") for number in ids], dtype=np.str_),
        instances=np.array([str(thing or "") for thing in things], dtype=np.str_),
        num_points=np.array([record.integer("num_points", 0) for record in records], dtype=np.int64),
    )
