"""A DGP scene as a drive: its samples with images and point clouds, each with a pose, calibrations, 3D boxes."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import cache
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import Annotated

import numpy as np
from msgspec import Meta, Struct

from bevcli.errors import InputError
from bevcli.frame import FrameStamp
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import Camera, CameraRig, brown_conrady, default_ego_from_bev
from bevcli.geometry.transforms import Array, Pose, inverse, yaw_of_rotation
from bevcli.parsing.documents import LARGEST_INTEGER, Number, Text, read_json, typed
from bevcli.sequences.files.calibration_file import checked_camera
from bevcli.sequences.format import Format
from bevcli.sequences.images import FrameEntry, ImageSource, ListedDrive, bev_frame_notes, leads_out
from bevcli.sequences.options import InputOptions
from bevcli.workshop.formats.labels import names_of_format, with_track_velocities
from bevcli.workshop.formats.poses import PoseTable, motion_of_keyframes

# DDAD's class names; docs/other-inputs.md says what is lost. Names are compared without case; others, such as Wheeled
# Slow and Train, stay as they are, and are not scored.
CLASS_OF_CATEGORY = {
    "Person": "pedestrian",
    "Pedestrian": "pedestrian",
    "Bus/RV/Caravan": "bus",
    "Towed Object": "trailer",
    "Caravan/RV": "truck",
}
SHORTEST_QUATERNION = 1e-3
EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
BROWN_CONRADY = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
OTHER_LENSES = ("fisheye", "s1", "s2", "s3", "s4", "taux", "tauy", "alpha", "beta", "w", "xi", "equirectangular")
TENFOLD = "the times of the scene are after the year 2116: they are taken as ten times too large, as in DDAD"
BOXES_3D = "1"  # the number of 3D boxes among DGP's kinds of annotations


# The objects in the files of a scene, as far as they are used. Other members are left out.


class _StatedPose(Struct):
    rotation: dict[str, Number]  # qw, qx, qy, qz; a missing number is 0
    translation: dict[str, Number]  # x, y, z in metres

    def __post_init__(self) -> None:
        if not np.linalg.norm(_numbers(self.rotation, ("qw", "qx", "qy", "qz"))) > SHORTEST_QUATERNION:
            raise ValueError("expected a quaternion of norm 1, found norm 0")

    @property
    def pose(self) -> Pose:
        rotation = _numbers(self.rotation, ("qw", "qx", "qy", "qz"))
        return Pose(_numbers(self.translation, ("x", "y", "z")), rotation / np.linalg.norm(rotation))


class _Identity(Struct):
    timestamp: datetime
    name: str = ""  # of the sensor


class _Content(Struct, kw_only=True):
    pose: _StatedPose  # in the world, at its own time
    annotations: dict[str, Text] = {}  # files by kind


class _Image(_Content, kw_only=True):
    filename: Text
    width: int
    height: int


class _Contents(Struct):
    image: _Image | None = None
    point_cloud: _Content | None = None


class _Datum(Struct):
    key: Text
    id: _Identity
    datum: _Contents


class _Sample(Struct):
    id: _Identity
    calibration_key: Text
    datum_keys: list[str]


class _SceneFile(Struct):
    data: list[_Datum]
    samples: Annotated[list[_Sample], Meta(min_length=1)]
    ontologies: dict[str, Text] = {}  # files by kind of annotations


class _CalibrationFile(Struct):
    names: list[str]  # of the sensors
    intrinsics: list[dict[str, Number]]
    extrinsics: list[_StatedPose]


class _Class(Struct):
    name: Text
    id: int = 0


class _OntologyFile(Struct):
    items: list[_Class]


class _Box(Struct):
    pose: _StatedPose  # in the frame of the point cloud
    length: Number
    width: Number
    height: Number


class _Annotation(Struct):
    box: _Box
    class_id: int = 0
    instance_id: int = 0  # 0 is that of a box without one
    num_points: int = 0


class _BoxesFile(Struct):
    annotations: list[_Annotation]


def _numbers(stated: Mapping[str, float], names: Iterable[str]) -> Array:
    return np.array([stated.get(name, 0.0) for name in names], dtype=np.float64)


@dataclass(frozen=True)
class Calibration:
    """The poses of all sensors, and the lenses of the cameras among them, by sensor."""

    path: Path
    ego_from: Mapping[str, Pose]
    lenses: Mapping[str, Mapping[str, float]]

    def camera(self, name: str, size: tuple[int, int]) -> Camera:
        """A camera with the size of its image (width, height). Raises InputError."""
        lens = self.lenses[name]
        for other in OTHER_LENSES:
            if lens.get(other):
                raise InputError(
                    f'{self.path}: camera {name}: the lens has "{other}", which is not supported (expected a pinhole '
                    f"camera with {', '.join(BROWN_CONRADY)}): undistort the images"
                )
        fx, fy, cx, cy, skew = _numbers(lens, ("fx", "fy", "cx", "cy", "skew"))
        intrinsics = np.array([[fx, skew, cx], [0, fy, cy], [0, 0, 1]])
        distortion = brown_conrady(_numbers(lens, BROWN_CONRADY))
        return checked_camera(Camera(name, *size, intrinsics, self.ego_from[name].matrix, distortion), self.path)


def _read_calibration(path: Path) -> Calibration:
    file = typed(read_json(path), _CalibrationFile, path)
    if not len(file.names) == len(set(file.names)) == len(file.intrinsics) == len(file.extrinsics):
        raise InputError(f"{path}: expected as many names as intrinsics and extrinsics, each name once")
    ego_from = {name: stated.pose for name, stated in zip(file.names, file.extrinsics, strict=True)}
    return Calibration(path, ego_from, dict(zip(file.names, file.intrinsics, strict=True)))


@dataclass(frozen=True)
class Measurement:
    """One image or point cloud, with the time."""

    sensor: str
    content: _Image | _Content
    time_ns: int


@dataclass(frozen=True)
class Sample:
    """The images and point clouds of one moment, at least one. calibration: of their sensors."""

    time_ns: int
    data: tuple[Measurement, ...]
    calibration: Calibration

    def ego_pose(self, datum: Measurement) -> Pose:
        """world_from_ego at the time of one of its data."""
        ego_from_sensor = self.calibration.ego_from[datum.sensor].matrix
        return Pose.from_matrix(datum.content.pose.pose.matrix @ inverse(ego_from_sensor))

    def images(self) -> dict[str, _Image]:
        """Each camera's image."""
        return {datum.sensor: datum.content for datum in self.data if isinstance(datum.content, _Image)}

    def rig(self, others: Mapping[str, _Image]) -> CameraRig:
        """The cameras in the order of the calibration. others: their images elsewhere, for sizes. Raises InputError."""
        images = {**others, **self.images()}
        if unknown := [name for name in images if name not in self.calibration.ego_from]:
            raise InputError(f'{self.calibration.path}: has no sensor "{unknown[0]}", of which there are images')
        names = [name for name in self.calibration.ego_from if name in images]
        cameras = (self.calibration.camera(name, (images[name].width, images[name].height)) for name in names)
        return CameraRig(tuple(cameras), default_ego_from_bev(), ego_from_bev_assumed=True)


def _read_samples(path: Path, scene: _SceneFile, file: Path) -> tuple[tuple[Sample, ...], bool]:
    """The samples in order of time, and whether their times were divided by ten. Raises InputError.

    DDAD's files state tenths of microseconds as microseconds: a drive of 2019 seems to be of the year 2463, with one
    frame per second in place of ten.

    path: the folder of the scene. scene: the contents of its file.
    """
    stamps = [datum.id.timestamp for datum in scene.data] + [sample.id.timestamp for sample in scene.samples]
    stamps = [stamp if stamp.tzinfo else stamp.replace(tzinfo=UTC) for stamp in stamps]
    times = [(stamp - EPOCH) // timedelta(microseconds=1) * 1000 for stamp in stamps]
    tenfold = max(times) > LARGEST_INTEGER
    times = [time // 10 for time in times] if tenfold else times
    if not 0 <= min(times) <= max(times) <= LARGEST_INTEGER:
        raise InputError(f"{file}: has impossible times (expected years from 1970 on)")
    data = {datum.key: _measurement(datum, time) for datum, time in zip(scene.data, times, strict=False)}
    calibration_of = cache(lambda key: _read_calibration(path / "calibration" / f"{key}.json"))
    samples = [
        Sample(time, _data_of(sample, data, file), calibration_of(sample.calibration_key))
        for sample, time in zip(scene.samples, times[len(scene.data) :], strict=True)
    ]
    samples.sort(key=lambda sample: sample.time_ns)
    for sample in samples:
        for datum in sample.data:
            if datum.sensor not in sample.calibration.ego_from:
                raise InputError(f'{sample.calibration.path}: has no sensor "{datum.sensor}", which a sample has')
    if any(later.time_ns <= earlier.time_ns for earlier, later in pairwise(samples)):
        raise InputError(f"{file}: two samples have the same time (expected increasing times)")
    return tuple(samples), tenfold


def _measurement(datum: _Datum, time_ns: int) -> Measurement | None:
    content = datum.datum.image or datum.datum.point_cloud
    return None if content is None else Measurement(datum.id.name, content, time_ns)


def _data_of(sample: _Sample, data: Mapping[str, Measurement | None], file: Path) -> tuple[Measurement, ...]:
    for key in sample.datum_keys:
        if key not in data:
            raise InputError(f'{file}: a sample has the datum "{key:.40}", which is missing in "data"')
    of_sample = tuple(datum for key in sample.datum_keys if (datum := data[key]) is not None)
    if not of_sample:
        raise InputError(f"{file}: a sample has no image and no point cloud (expected at least one)")
    return of_sample


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
    file = _scene_file(path)
    scene = typed(read_json(file), _SceneFile, file)
    samples, tenfold = _read_samples(path, scene, file)
    images = {name: image for sample in samples for name, image in sample.images().items()}
    if not images:
        raise InputError(f"{file}: no sample has an image (expected at least one)")
    rigs = tuple(sample.rig(images) for sample in samples)
    entries = tuple(_entry(path, index, sample, rigs[0], common) for index, sample in enumerate(samples))
    motion = motion_of_keyframes(_poses(samples, keys=True), _poses(samples, keys=False))
    truth = _read_truth(path, scene, samples, common) if common.ground_truth else {}
    notes = (*bev_frame_notes(rigs[0], "a DGP scene"), *((TENFOLD,) if tenfold else ()))
    files = tuple(sorted((*path.glob("scene_*.json"), *path.glob("calibration/*.json"))))
    return ListedDrive(path, common, rigs, entries, motion, truth, notes, files)


def _entry(path: Path, index: int, sample: Sample, rig: CameraRig, common: InputOptions) -> FrameEntry:
    sources = {
        datum.sensor: ImageSource(_file(path, datum.content.filename, common), datum.time_ns)
        for datum in sample.data
        if isinstance(datum.content, _Image)
    }
    dropped = {name: "no image in the sample" for name in rig.names if name not in sources}
    return FrameEntry(FrameStamp(index, "", sample.time_ns), sources, dropped, str(path))


def _file(path: Path, name: str, common: InputOptions) -> Path:
    """The file that a member of an object names. Raises InputError for one outside of the folder."""
    file = path / PurePosixPath(name)
    if not common.allow_outside and leads_out(file, path):
        raise InputError(f"{file}: leads out of the folder: pass `allow_outside=True` (`--allow-outside`) to read it")
    return file


def _read_truth(path: Path, scene: _SceneFile, samples: Iterable[Sample], common: InputOptions) -> dict[int, Boxes3D]:
    """The boxes in the world frame of each sample that has a point cloud with boxes."""
    boxes_of, times = {}, []
    classes: dict[int, str] | None = None
    for index, sample in enumerate(samples):
        clouds = (datum.content for datum in sample.data if not isinstance(datum.content, _Image))
        for cloud in (cloud for cloud in clouds if BOXES_3D in cloud.annotations):
            classes = _read_ontology(path, scene, common.class_map) if classes is None else classes
            file = _file(path, cloud.annotations[BOXES_3D], common)
            boxes_of[index] = _read_boxes(file, cloud.pose.pose.matrix, classes)
            times.append(sample.time_ns)
            break
    return dict(zip(boxes_of, with_track_velocities(list(boxes_of.values()), times), strict=True))


def _scene_file(path: Path) -> Path:
    files = sorted(path.glob("scene_*.json"))
    if len(files) == 1:
        return files[0]
    names = ", ".join(file.name for file in files[:4]) or "none"
    raise InputError(f"{path}: expected one file scene_*.json, found {names}")


def _read_ontology(folder: Path, scene: _SceneFile, class_map: Mapping[str, str]) -> dict[int, str]:
    path = folder / "ontology" / f"{scene.ontologies.get(BOXES_3D)}.json"
    names = names_of_format(CLASS_OF_CATEGORY, class_map)
    return {each.id: names[each.name] for each in typed(read_json(path), _OntologyFile, path).items}


def _read_boxes(path: Path, world_from_sensor: Array, classes: Mapping[int, str]) -> Boxes3D:
    rows = typed(read_json(path), _BoxesFile, path).annotations
    if not rows:
        return Boxes3D.empty()
    world_from_box = [world_from_sensor @ row.box.pose.pose.matrix for row in rows]
    return Boxes3D(
        np.stack([pose[:3, 3] for pose in world_from_box]),
        np.array([[row.box.length, row.box.width, row.box.height] for row in rows], dtype=np.float64),
        np.array([yaw_of_rotation(pose[:3, :3]) for pose in world_from_box]),
        np.full((len(rows), 2), np.nan),
        np.array([classes.get(row.class_id, f"class {row.class_id}") for row in rows], dtype=np.str_),
        instances=np.array([str(row.instance_id or "") for row in rows], dtype=np.str_),
        num_points=np.array([row.num_points for row in rows], dtype=np.int64),
    )
