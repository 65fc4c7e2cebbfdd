"""The samples of a DGP scene: its images and point clouds by time, each with a pose."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.cameras import CameraRig, default_ego_from_bev
from bevcli.geometry.ego_motion import PoseTable
from bevcli.geometry.transforms import Pose, inverse
from bevcli.sequences.dgp.records import Calibration, Record, nanoseconds, read_calibration


@dataclass(frozen=True)
class Datum:
    """One image or point cloud.

    Attributes:
        sensor: the camera or lidar.
        is_image: whether it is an image.
        content: the object "image" or "point_cloud" in the file.
        time_ns: its own time.
        world_from_sensor: at its own time.
    """

    sensor: str
    is_image: bool
    content: Record
    time_ns: int
    world_from_sensor: Pose


@dataclass(frozen=True)
class Sample:
    """The images and point clouds of one moment.

    Attributes:
        time_ns: of the moment.
        data: at least one image among them.
        calibration: of their sensors.
    """

    time_ns: int
    data: tuple[Datum, ...]
    calibration: Calibration

    def ego_pose(self, datum: Datum) -> Pose:
        """world_from_ego at the time of one of its data."""
        return Pose.from_matrix(
            datum.world_from_sensor.matrix @ inverse(self.calibration.ego_from[datum.sensor].matrix)
        )

    def rig(self) -> CameraRig:
        """The cameras that have an image, in the order of the calibration. Raises InputError."""
        images = {datum.sensor: datum.content for datum in self.data if datum.is_image}
        names = [name for name in self.calibration.ego_from if name in images]
        sizes = [(images[name].integer("width"), images[name].integer("height")) for name in names]
        cameras = tuple(map(self.calibration.camera, names, sizes))
        return CameraRig(cameras, default_ego_from_bev(), ego_from_bev_assumed=True)


def read_samples(path: Path, scene: Record) -> tuple[tuple[Sample, ...], bool]:
    """The samples in order of time, and whether the times were divided by ten, see `nanoseconds`. Raises InputError.

    path: the folder of the scene. scene: the contents of its file.
    """
    records = {record.text("key"): record for record in scene.records("data")}
    samples = sorted(scene.records("samples"), key=lambda sample: sample.record("id").timestamp())
    if not samples:
        raise InputError(f"{scene.where}: has no samples (expected at least one)")
    owners = [*records.values(), *samples]
    times, tenfold = nanoseconds([owner.record("id").timestamp() for owner in owners], scene.where)
    data = {key: _datum(record, time) for (key, record), time in zip(records.items(), times, strict=False)}
    calibration_of = cache(lambda key: read_calibration(path / "calibration" / f"{key}.json"))
    found = []
    for sample, time in zip(samples, times[len(records) :], strict=True):
        calibration = calibration_of(sample.text("calibration_key"))
        found.append(Sample(time, _data_of(sample, data, calibration), calibration))
    if any(later.time_ns <= earlier.time_ns for earlier, later in pairwise(found)):
        raise InputError(f"{scene.where}: two samples have the same time (expected increasing times)")
    return tuple(found), tenfold


def _data_of(sample: Record, data: dict[str, Datum | None], calibration: Calibration) -> tuple[Datum, ...]:
    """The images and point clouds of a sample. Raises InputError for one that is missing."""
    found = []
    for key in sample.texts("datum_keys"):
        if key not in data:
            raise InputError(f'{sample.where}: datum "{key:.40}" is missing in "data"')
        datum = data[key]
        if datum is None:
            continue
        if datum.sensor not in calibration.ego_from:
            raise InputError(f'{sample.where}: its calibration has no sensor "{datum.sensor}"')
        found.append(datum)
    if not any(datum.is_image for datum in found):
        raise InputError(f"{sample.where}: has no image (expected at least one)")
    return tuple(found)


def _datum(record: Record, time_ns: int) -> Datum | None:
    """The image or point cloud of a record; None for radar and other data."""
    contents = record.record("datum")
    kind = next((name for name in ("image", "point_cloud") if name in contents.value), None)
    if kind is None:
        return None
    content = contents.record(kind)
    pose = content.record("pose").pose()
    return Datum(record.record("id").text("name"), kind == "image", content, time_ns, pose)


def poses(samples: Iterable[Sample], *, keys: bool) -> PoseTable:
    """The poses at the times of all data; or only the one of each sample that is nearest to its time, at that time."""
    rows = []
    for sample in samples:
        nearest = min(sample.data, key=lambda datum: abs(datum.time_ns - sample.time_ns))
        data = [(sample.time_ns, nearest)] if keys else [(datum.time_ns, datum) for datum in sample.data]
        rows += [(time, sample.ego_pose(datum)) for time, datum in data]
    times = np.array([time for time, _ in rows], dtype=np.int64)
    return times, np.stack([pose.translation for _, pose in rows]), np.stack([pose.quaternion for _, pose in rows])
