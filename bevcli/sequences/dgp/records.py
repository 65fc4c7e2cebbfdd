"""The JSON files of a DGP scene: the scene with its data and samples, and calibrations."""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.cameras import Camera, brown_conrady
from bevcli.geometry.transforms import Array, Pose
from bevcli.parsing.documents import LARGEST_INTEGER, read_json
from bevcli.sequences.files.calibration_file import LARGEST_SIZE, is_file_name

LARGEST_NUMBER = 1e12  # metres or pixels
SHORTEST_QUATERNION = 1e-3
EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
PINHOLE = ("fx", "fy", "cx", "cy")
BROWN_CONRADY = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
OTHER_LENSES = ("fisheye", "s1", "s2", "s3", "s4", "taux", "tauy", "alpha", "beta", "w", "xi", "equirectangular")


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
        return [Record(one, f"{self.where}: {name}[{place}]") for place, one in enumerate(value)]

    def text(self, name: str) -> str:
        """A member that is a text of at most 400 characters. Raises InputError."""
        value = self._member(name)
        if not isinstance(value, str) or not 0 < len(value) <= 400:
            raise InputError(f'{self.where}: "{name}": expected a text of at most 400 characters')
        return value

    def texts(self, name: str) -> list[str]:
        """A member that is a list of texts. Raises InputError."""
        value = self._member(name)
        if not isinstance(value, list) or not all(isinstance(one, str) for one in value):
            raise InputError(f'{self.where}: "{name}": expected a list of texts')
        return value

    def numbers(self, names: tuple[str, ...], default: float | None = None) -> Array:
        """(N,) members that are finite numbers. A missing one is `default`; with None it raises InputError."""
        values = [self._member(name) if default is None or name in self.value else default for name in names]
        if any(type(one) not in (int, float) or not abs(one) < LARGEST_NUMBER for one in values):
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


def nanoseconds(times: list[datetime], where: str) -> tuple[list[int], bool]:
    """The times since 1970 in ns, and whether they were divided by ten. Raises InputError beyond any year.

    DDAD's files state tenths of microseconds as microseconds: a drive of 2019 seems to be of the year 2463, with one
    frame per second in place of ten. where: start of a message.
    """
    found = [(time - EPOCH) // timedelta(microseconds=1) * 1000 for time in times]
    tenfold = max(found) > LARGEST_INTEGER
    found = [time // 10 for time in found] if tenfold else found
    if not 0 <= min(found) <= max(found) <= LARGEST_INTEGER:
        raise InputError(
            f"{where}: the times {min(times)} to {max(times)} are impossible (expected years from 1970 on)"
        )
    return found, tenfold


@dataclass(frozen=True)
class Calibration:
    """The poses of all sensors, and the lenses of the cameras among them.

    Attributes:
        ego_from: by sensor.
        lenses: by sensor.
    """

    ego_from: Mapping[str, Pose]
    lenses: Mapping[str, Record]

    def camera(self, name: str, size: tuple[int, int]) -> Camera:
        """A camera with the size of its image (width, height). Raises InputError."""
        lens = self.lenses[name]
        fx, fy, cx, cy = lens.numbers(PINHOLE)
        if not (is_file_name(name) and 0 < min(size) <= max(size) <= LARGEST_SIZE and min(fx, fy) > 0):
            raise InputError(
                f"{lens.where}: camera {name:.60}: expected an image size and focal lengths above 0, "
                f"found {size[0]}x{size[1]}, {fx:g}, {fy:g}"
            )
        for other in OTHER_LENSES:
            if lens.numbers((other,), 0.0).any():
                raise InputError(
                    f'{lens.where}: camera {name}: the lens has "{other}", which is not supported (expected a pinhole '
                    f"camera with {', '.join(BROWN_CONRADY)}): undistort the images"
                )
        (skew,) = lens.numbers(("skew",), 0.0)
        intrinsics = np.array([[fx, skew, cx], [0, fy, cy], [0, 0, 1]])
        distortion = brown_conrady(lens.numbers(BROWN_CONRADY, 0.0))
        return Camera(name, *size, intrinsics, self.ego_from[name].matrix, distortion)


def read_calibration(path: Path) -> Calibration:
    """A file of the folder calibration. Raises InputError."""
    record = read_record(path)
    names, lenses, poses = record.texts("names"), record.records("intrinsics"), record.records("extrinsics")
    if not len(names) == len(set(names)) == len(lenses) == len(poses):
        raise InputError(f"{path}: expected as many names as intrinsics and extrinsics, each name once")
    return Calibration(
        dict(zip(names, (pose.pose() for pose in poses), strict=True)), dict(zip(names, lenses, strict=True))
    )
