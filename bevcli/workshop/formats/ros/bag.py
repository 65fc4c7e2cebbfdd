"""The files of one recording as topics with indexed messages; the topics of each camera and of the vehicle's poses.

A TOML states what type and name of a topic do not show:
ego_frame = "base_link"                                  # the frame of the vehicle
world_frame = "map"                                      # the frame that poses from /tf refer to
ego_motion = "/localization/kinematic_state"             # a topic with poses, or /tf
[cameras]                                                # only these cameras are used
CAM_FRONT = "/sensing/camera/camera0/image_raw/compressed"
[calibration]                                            # a camera's CameraInfo
CAM_FRONT = "/sensing/camera/camera0/camera_info"
[frames]                                                 # a camera's optical frame
CAM_FRONT = "camera0/camera_optical_link"
"""

import re
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence as Indices
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import BevcliError, InputError
from bevcli.parsing.documents import TOML_BYTES, parse_toml, typed
from bevcli.parsing.files import MIB, read_text
from bevcli.printing import aligned, counted, reason_of
from bevcli.workshop.formats import BAG_METADATA, BAG_SUFFIXES, is_packed_bag
from bevcli.workshop.formats.markup import read_yaml
from bevcli.workshop.formats.ros.messages import KINDS, Kind, frame_of
from bevcli.workshop.formats.ros.storage import McapFile, SqliteFile, decoder, decompressed

SPLIT_NUMBER = re.compile(r"_\d+$")  # rosbag2 numbers the files of a recording: drive_0.mcap, drive_1.mcap
LARGEST_MESSAGE = 256 * MIB  # bytes after decompression
MOST_INVALID = 1000  # messages of a topic before the first valid one
_Value = TypeVar("_Value")
# Parts of a topic's name that do not name a camera.
GENERIC = re.compile(
    r"(image|img)?_?(raw|rect|rectified|color|colour|rgb|bgr|mono|compressed|image|img|video|h264|h265|stream|_)*"
)
# Parts of names of images that no camera took, or not in the visible spectrum.
NOT_A_CAMERA = re.compile(
    r"depth|disparity|confidence|mask|semantic|segment|label|debug|overlay|annotat|detect|infra|thermal|theora|bev|map"
)
RECTIFIED = re.compile(r"(^|[/_])rect(ified)?([/_]|$)")
PREFERRED_POSES = ("/localization/kinematic_state", "/localization/pose_twist_fusion_filter/kinematic_state")
GOALS = re.compile(r"goal|target|initial|waypoint|planning|planner|prediction|perception|object")  # not the ego pose


@contextmanager
def _broken_files_refused(path: Path) -> Iterator[None]:
    """Makes one InputError of one line of what the packages for MCAP, SQLite and ROS raise for broken bytes."""
    try:
        yield
    except Exception as error:
        reason = reason_of(error)
        if isinstance(error, BevcliError):
            raise type(error)(reason if str(path) in reason else f"{path}: {reason}") from None
        raise InputError(f"{path}: is damaged ({reason:.200})") from None


class Bag:
    """A recording of one or more files. Messages are numbered by topic, in order of time. Safe to use from threads.

    Raises InputError if a file is missing or broken, or the packages of the extra `ros` are not installed.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock = threading.RLock()
        self._compression = ""
        with _broken_files_refused(path):
            self.file_paths = tuple(self._file_paths())
            self._files = [_open_file(file) for file in self.file_paths]
            self.size = sum(file.stat().st_size for file in self.file_paths)  # bytes
        self.topics = {name: topic for file in self._files for name, topic in sorted(file.topics.items())}
        self._decoder = cache(lambda topic: decoder(self.topics[topic]))

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the user about the files."""
        return tuple(note for file in self._files for note in file.notes)

    def times(self, topic: str) -> NDArray[np.int64]:
        """(N,) log times of a topic's messages, ns. They come from the index."""
        with self._lock, _broken_files_refused(self.path):
            parts = [file.times(topic) for file in self._files if topic in file.topics]
        return np.concatenate([np.zeros(0, dtype=np.int64), *parts])

    def message(self, topic: str, index: int) -> Any:
        """Message `index` of a topic, from 0. Raises InputError if it is broken."""
        with self._lock, _broken_files_refused(self.path):
            data, decode = self._bytes(topic, index), self._decoder(topic)
        try:
            return decode(data)
        except Exception as error:  # the decoders of the packages raise errors of many types for broken bytes
            reason = reason_of(error)
            raise InputError(f"{self.path}: {topic}: message {index} cannot be decoded ({reason:.200})") from None

    def read(self, topic: str, index: int, parse: Callable[[Any], _Value], description: str) -> _Value:
        """The value that `parse` makes of a message. Raises InputError also for none of a `description` ("a pose")."""
        message = self.message(topic, index)
        try:
            return parse(message)
        except (AttributeError, ValueError) as error:
            raise InputError(f"{self.path}: {topic}: message {index} is not {description} ({error})") from None

    def first(self, topic: str, parse: Callable[[Any], _Value], description: str) -> _Value:
        """The first value of a topic's messages that is valid, and not empty: nodes publish before they are set up.

        Raises InputError as `read` for the first message, if no message has a value.
        """
        values: list[_Value] = []
        invalid: InputError | None = None
        for index in range(min(len(self.times(topic)), MOST_INVALID)):
            try:
                values.append(self.read(topic, index, parse, description))
            except InputError as error:
                invalid = invalid or error
            if values and values[-1]:
                break
        if not values and invalid is not None:
            raise invalid
        return values[-1]

    def _bytes(self, topic: str, index: int) -> bytes:
        for file in self._files:
            count = len(file.times(topic)) if topic in file.topics else 0
            if index < count:
                data = file.read(topic, index)
                return decompressed("zstd", data, LARGEST_MESSAGE) if self._compression == "message" else data
            index -= count
        raise IndexError(f"{topic} has no message {index}")

    def _file_paths(self) -> list[Path]:
        """The files in order. Also notes whether rosbag2 compressed single messages."""
        if self.path.is_file():
            return [self.path]
        files = sorted(file for file in self.path.iterdir() if file.suffix in BAG_SUFFIXES)
        metadata = _metadata(self.path / BAG_METADATA)
        listed = [self.path / Path(name).name for name in metadata.get("relative_file_paths", [])]
        mode = str(metadata.get("compression_mode", "")).lower()
        packed = sorted(file.name for file in self.path.iterdir() if is_packed_bag(file))
        if packed and not files:
            raise InputError(f"{self.path}: its files are compressed: decompress them first (zstd -d {packed[0]})")
        self._compression = mode
        paths = [file for file in listed if file.suffix in BAG_SUFFIXES and file.is_file()] or files
        if not listed and len({SPLIT_NUMBER.sub("", file.stem) for file in paths}) > 1:
            names = ", ".join(file.name for file in paths[:4])
            raise InputError(f"{self.path}: has several bags and no {BAG_METADATA}: pass one of them ({names})")
        if not paths:
            raise InputError(f"{self.path}: has no .mcap or .db3 file (expected those listed in {BAG_METADATA})")
        return sorted(paths, key=_number) if not listed else paths


def _metadata(path: Path) -> dict[str, Any]:
    """The statements of metadata.yaml; empty without the file, which a recording that was cut off does not have."""
    try:
        document = read_yaml(path)
    except InputError:
        return {}
    bag_information = document.get("rosbag2_bagfile_information") if isinstance(document, dict) else None
    return bag_information if isinstance(bag_information, dict) else {}


def _open_file(path: Path) -> McapFile | SqliteFile:
    if not path.stat().st_size:
        raise InputError(f"{path}: the file is empty")
    return McapFile(path) if path.suffix == ".mcap" else SqliteFile(path)


def _number(file: Path) -> tuple[int, str]:
    digits = file.stem.rpartition("_")[2]
    return (int(digits) if digits.isdigit() else 0, file.name)


def spread(count: int, most: int) -> Indices[int]:
    """Up to `most` different indices below `count`, evenly spread, with the first and the last."""
    indices: list[int] = np.unique(np.linspace(0, count - 1, min(count, most)).astype(int)).tolist()
    return indices


@dataclass(frozen=True)
class StatedTopics:
    """Statements of the user about a bag, by the keys of the TOML above. "" and missing cameras: to be found.

    renamed: camera -> image topic, as `topics` states it; other cameras are still found.
    """

    ego_frame: str = ""
    world_frame: str = ""
    ego_motion: str = ""
    cameras: Mapping[str, str] = field(default_factory=dict)
    calibration: Mapping[str, str] = field(default_factory=dict)
    frames: Mapping[str, str] = field(default_factory=dict)
    renamed: Mapping[str, str] = field(default_factory=dict)


def read_topics_file(path: Path | None, topics: Mapping[str, str]) -> StatedTopics:
    """The statements of a TOML file (None: no file) and of `topics`.

    topics: camera -> image topic. Raises InputError for broken TOML, an unknown key or a wrong type.
    """
    if path is None:
        return StatedTopics(renamed=topics)
    document = parse_toml(read_text(path, TOML_BYTES), path)
    names = [entry.name for entry in fields(StatedTopics) if entry.name != "renamed"]
    for key in document:
        if key not in names:
            raise InputError(f'{path}: unknown key "{key}" (known: {", ".join(names)})')
    return replace(typed(document, StatedTopics, path), renamed=topics)


@dataclass(frozen=True)
class CameraTopics:
    """The topics of one camera: of its images, and of its intrinsics. is_video: the images are packets of a video."""

    camera: str
    images: str
    calibration: str | None
    is_video: bool = False

    @property
    def is_rectified(self) -> bool:
        """True if the name of the topic says that lens distortion was removed from the images."""
        return RECTIFIED.search(self.images) is not None


class TopicFinder:
    """The topics of a bag that have messages, by kind. stated: what the user states. Raises InputError as its methods.

    Attributes:
        cameras: the topics of each camera, in order of their names.
        left_out: image topics without a calibration topic.
    """

    def __init__(self, bag: Bag, stated: StatedTopics, calibrated: Iterable[str] | None = None) -> None:
        """calibrated: the cameras of a calibration file. None: the bag is the calibration."""
        self._bag, self._topics = bag, stated
        self._kinds = {
            name: KINDS[topic.short_type]
            for name, topic in bag.topics.items()
            if topic.short_type in KINDS and len(bag.times(name))
        }
        for name in (*stated.cameras.values(), *stated.renamed.values(), *stated.calibration.values()):
            self._check_exists(name)
        images_of = self._found_images()
        images_of = dict(_for_calibration(images_of, tuple(calibrated), bag)) if calibrated is not None else images_of
        cameras = [
            CameraTopics(name, images, self._calibration_of(name, images), self._kinds[images] == "video")
            for name, images in images_of.items()
        ]
        without = [camera for camera in cameras if camera.calibration is None and calibrated is None]
        for camera in without:
            if camera.camera in (*stated.cameras, *stated.renamed) or len(without) == len(cameras):
                raise InputError(
                    f"{bag.path}: camera {camera.camera}: no CameraInfo belongs to {camera.images}: pass `calibration` "
                    "(`--calibration FILE`), or name the topic with `topics_file` (`--topics FILE.toml`) "
                    f"({self.seen()})"
                )
        self.left_out = tuple(camera.images for camera in without)
        self.cameras = tuple(camera for camera in cameras if camera not in without)
        if not self.cameras:
            raise InputError(
                f"{bag.path}: has no image topic ({self.seen()}): name them with `topics={{'CAMERA': '/TOPIC'}}` "
                "(`--topic CAMERA=/TOPIC`)"
            )

    def of_kind(self, kind: Kind) -> list[str]:
        """Names of the topics of a kind that have messages."""
        return [name for name, topic_kind in self._kinds.items() if topic_kind == kind]

    def pose_topic(self) -> str | None:
        """The topic of the vehicle's poses: Odometry rather than a pose. None: they may be in the transforms."""
        stated_topic = self._topics.ego_motion
        if stated_topic:
            self._check_exists(stated_topic)
            return stated_topic if self._kinds[stated_topic] == "pose" else None
        poses = [name for name in self.of_kind("pose") if not GOALS.search(name)]
        return min(poses, key=lambda name: (name not in PREFERRED_POSES, self._preference(name), name), default=None)

    def seen(self) -> str:
        """The topics of the bag, for an error message."""
        names = [f"{name} ({topic.short_type})" for name, topic in self._bag.topics.items()]
        return "topics: " + (", ".join(names[:12]) + (", ..." if len(names) > 12 else "") if names else "none")

    def table(self, pose: str) -> str:
        """A table of the topics that are used and those that are not. pose: where poses come from, "" for nowhere."""
        rows = []
        for camera in self.cameras:
            rows.append((camera.camera, camera.images))
            if camera.calibration:
                rows.append(("  calibration", camera.calibration))
        rows += [("ego-motion", pose)] if pose else []
        rows += [("transforms", name) for name in self.of_kind("transforms") if name != pose]
        used = {name for _, name in rows}
        rows += [("not used", name) for name in self._bag.topics if name not in used]
        lines = [(f"  {role}", name, *self._type_and_count(name)) for role, name in rows]
        return "topics:\n" + aligned(lines, left=range(4))

    def _type_and_count(self, name: str) -> tuple[str, str]:
        times = self._bag.times(name)
        rate = f", {1e9 / np.median(np.diff(times)):.3g} Hz" if len(times) > 2 and np.median(np.diff(times)) else ""
        return self._bag.topics[name].short_type, counted(len(times), "messages") + rate

    def _check_exists(self, name: str) -> None:
        if name not in self._bag.topics:
            raise InputError(f"{self._bag.path}: has no topic {name} ({self.seen()})")
        if name not in self._kinds:
            type_name = self._bag.topics[name].short_type
            problem = f"type {type_name} cannot be used" if len(self._bag.times(name)) else "has no messages"
            raise InputError(f"{self._bag.path}: topic {name}: {problem} ({self.seen()})")

    def _found_images(self) -> dict[str, str]:
        """Camera -> image topic: the stated ones, and one for each other group of topics."""
        if self._topics.cameras:
            return {**self._topics.cameras, **self._topics.renamed}
        taken = {_camera_path(name) for name in self._topics.renamed.values()}
        groups: dict[tuple[str, ...], list[str]] = {}
        for name in sorted([*self.of_kind("image"), *self.of_kind("video")]):
            if not NOT_A_CAMERA.search(name.lower()) and _camera_path(name) not in taken:
                groups.setdefault(_camera_path(name), []).append(name)
        best = {
            path: min(topics, key=lambda name: (self._preference(name), not RECTIFIED.search(name), name))
            for path, topics in groups.items()
        }
        return {**self._topics.renamed, **dict(_named(best))}

    def _preference(self, name: str) -> int:
        return list(KINDS).index(self._bag.topics[name].short_type)

    def _calibration_of(self, camera: str, images: str) -> str | None:
        """The calibration topic in the nearest namespace around the images, or else with the same frame."""
        if camera in self._topics.calibration:
            return self._topics.calibration[camera]
        infos = self.of_kind("calibration")
        around = [name for name in infos if images.startswith(name.rpartition("/")[0] + "/")]
        nested = [name for name in around if name.rpartition("/")[0]]
        if nested:
            return max(nested, key=lambda name: (len(name.rpartition("/")[0]), name))
        frame = frame_of(self._bag.message(images, 0))
        same = [name for name in infos if frame_of(self._bag.message(name, 0)) == frame]
        return same[0] if len(same) == 1 and frame else None


def _camera_path(topic: str) -> tuple[str, ...]:
    """The words of a topic's name that name the camera: /camera/front/image_raw -> (camera, front)."""
    words = [word for word in topic.split("/") if word]
    return tuple(word for word in words if not GENERIC.fullmatch(word.lower())) or (words[-1],)


def _named(topics: Mapping[tuple[str, ...], str]) -> Iterator[tuple[str, str]]:
    """Camera -> topic, with as many parts of each path as make the names different."""
    for path, topic in topics.items():
        for count in range(1, len(path) + 1):
            if sum(other[-count:] == path[-count:] for other in topics) == 1:
                break
        yield "_".join(path[-count:]), topic


def _fitting(topics: Mapping[str, str], lower: str) -> list[str]:
    """The topics of a camera, by its name in lower case."""
    same = [topic for camera, topic in topics.items() if camera.lower() == lower]
    return same or [topic for topic in topics.values() if lower in topic.lower().split("/")]


def _for_calibration(topics: Mapping[str, str], names: tuple[str, ...], bag: Bag) -> Iterator[tuple[str, str]]:
    """Camera of a calibration file -> topic: of the same name, or with the name as a part.

    Cameras without a topic are left out where each topic belongs to another one.
    """
    fitting_of = {name: _fitting(topics, name.lower()) for name in names}
    are_taken = {fitting[0] for fitting in fitting_of.values() if len(fitting) == 1} == set(topics.values()) != set()
    for name, fitting in fitting_of.items():
        if are_taken and not fitting:
            continue
        if len(fitting) != 1:
            offered = ", ".join(topics.values()) or "none"
            raise InputError(
                f"{bag.path}: camera {name} of the calibration: its image topic was not found (image topics: "
                f"{offered}): pass `topics={{{name!r}: '/TOPIC'}}` (`--topic {name}=/TOPIC`)"
            )
        yield name, fitting[0]
