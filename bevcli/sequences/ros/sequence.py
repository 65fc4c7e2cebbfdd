"""A ROS 2 bag or an MCAP file as a Sequence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.frame import DriveFacts, Frame, FrameStamp
from bevcli.geometry.cameras import Camera, CameraRig, default_ego_from_bev
from bevcli.geometry.ego_motion import TOLERANCE_NS, EgoMotion
from bevcli.geometry.transforms import Array, rigid
from bevcli.sequences.files.calibration_file import read_calibration, read_facts
from bevcli.sequences.frame_reading import read_frame
from bevcli.sequences.images import ImageReader, Source
from bevcli.sequences.native.ego_motion_file import read_ego_motion
from bevcli.sequences.native.folder import EgoMotionUse, rig_notes
from bevcli.sequences.native.frames_table import FrameEntry
from bevcli.sequences.ros.bag import Bag
from bevcli.sequences.ros.capture_times import capture_times
from bevcli.sequences.ros.ego_motion import BagEgoMotion, motion_from_poses, motion_from_transforms
from bevcli.sequences.ros.geo_origin import find_geo_origin
from bevcli.sequences.ros.images import BagImage
from bevcli.sequences.ros.messages import CameraInfo, camera_info_of, frame_of, pose_of
from bevcli.sequences.ros.packets import BagVideo
from bevcli.sequences.ros.topics import CameraTopics, TopicFinder
from bevcli.sequences.ros.topics_file import StatedTopics
from bevcli.sequences.ros.transforms import TransformTree, is_static, sampled_transforms

# Usual names of the frame of the vehicle, and of the world.
EGO_FRAMES = ("base_link", "base_footprint", "ego_vehicle", "ego", "vehicle", "vehicle_frame", "chassis")
SAME_RATE = 0.98  # cameras whose rates differ by less have the same rate; the first of them leads
CALIBRATION_FILE, EGO_MOTION_FILE = "calibration.json", "ego_motion.csv"


class RosSequence:
    """A bag as a `Sequence`. Opening it reads the index, the calibration and the static transforms.

    The camera with the lowest rate leads: each of its images is a frame, with the other cameras' nearest images.

    stated: what the user states about its topics. rig, ego_motion_file: replace those of the bag.
    Raises InputError if the bag is broken, or cameras, extrinsics or poses are not found.
    """

    def __init__(
        self,
        path: Path,
        *,
        ego_motion: EgoMotionUse = "required",
        strict: bool = False,
        stated: StatedTopics = StatedTopics(),
        rig: CameraRig | None = None,
        ego_motion_file: Path | None = None,
    ) -> None:
        self.path = path
        self.name = path.resolve().stem if path.is_file() else path.resolve().name
        self._bag = Bag(path)
        folder = path.parent if path.is_file() else path
        beside: list[str] = []
        if rig is None and (folder / CALIBRATION_FILE).is_file():
            rig = read_calibration(folder / CALIBRATION_FILE)
            beside.append(f"{folder / CALIBRATION_FILE} is used in place of the calibration in the bag")
        if ego_motion_file is None and ego_motion != "static" and (folder / EGO_MOTION_FILE).is_file():
            ego_motion_file = folder / EGO_MOTION_FILE
            beside.append(f"{ego_motion_file} is used in place of the poses in the bag")
        finder = TopicFinder(self._bag, stated, rig.names if rig else None)
        static, changing = sampled_transforms(self._bag, finder.of_kind("transforms"))
        tree = TransformTree([*static, *changing])
        reader = _RigReader(self._bag, finder, stated, tree)
        self.rig = reader.rig() if rig is None else rig
        motion = _find_motion(self._bag, finder, stated, tree, reader, ego_motion, ego_motion_file)
        self._motion = motion.poses
        self.has_ego_motion = motion.poses is not None
        calibration = folder / CALIBRATION_FILE
        stated_facts = read_facts(calibration) if calibration.is_file() else DriveFacts()
        self.facts = replace(
            stated_facts, geo_origin=stated_facts.geo_origin or find_geo_origin(self._bag, motion.poses)
        )
        entries = _entries(self._bag, finder.cameras)
        self._entries = _covered(entries, self._motion, path)
        self.notes = (
            finder.table(motion.source),
            *self._bag.notes,
            *beside,
            *reader.notes,
            *(f"{name} is not used: no CameraInfo belongs to it" for name in finder.left_out),
            *rig_notes(self.rig, "the calibration" if rig else "a bag"),
            *motion.notes,
            *_coverage_notes(len(entries), len(self._entries)),
        )
        self._images = ImageReader(strict=strict)

    @property
    def stamps(self) -> tuple[FrameStamp, ...]:
        """Index, scene and time of each frame, in order."""
        return tuple(entry.stamp for entry in self._entries)

    def load(self, place: int) -> Frame:
        """The frame at position `place`, with decoded images. Raises InputError as `ImageReader.read`."""
        return read_frame(self._entries[place], self.rig, self._images, self._motion)


class _RigReader:
    """Reads the rig of a bag: CameraInfo and the transforms from the cameras to the vehicle."""

    def __init__(self, bag: Bag, finder: TopicFinder, stated: StatedTopics, tree: TransformTree) -> None:
        self._bag, self._finder, self._stated, self._tree = bag, finder, stated, tree
        self.notes: list[str] = []
        self.ego_frame = stated.ego_frame

    def rig(self) -> CameraRig:
        """The cameras, in order of their names as found. Raises InputError if intrinsics or extrinsics are missing."""
        infos = {one.camera: self._info(one) for one in self._finder.cameras}
        frames = {name: self._stated.frames.get(name) or info.frame for name, info in infos.items()}
        self.ego_frame = self.ego_frame or self._find_ego_frame(list(frames.values()))
        cameras = [
            self._camera(one, infos[one.camera], self._ego_from(frames[one.camera], one.camera))
            for one in self._finder.cameras
        ]
        return CameraRig(tuple(cameras), default_ego_from_bev(), ego_from_bev_assumed=True)

    def _info(self, topics: CameraTopics) -> CameraInfo:
        assert topics.calibration is not None
        where = f"{self._bag.path}: {topics.calibration}"
        try:
            info = camera_info_of(self._bag.message(topics.calibration, 0), where)
        except (AttributeError, ValueError) as error:
            raise InputError(f"{where}: is not a calibration ({error})") from None
        frame = frame_of(self._bag.message(topics.images, 0)) or info.frame
        return replace(info, frame=frame)

    def _find_ego_frame(self, camera_frames: list[str]) -> str:
        """The frame of the vehicle: the one that a pose topic names, a usual name, or the root of all cameras."""
        above = [self._tree.path_up(frame) for frame in camera_frames]
        pose = self._finder.pose_topic()
        named = pose_of(self._bag.message(pose, 0)).child if pose else ""
        for name in (named, *EGO_FRAMES):
            if name and name in self._tree.frames:
                return name
        common = [frame for frame in above[0] if all(frame in path for path in above)]
        if not common or common[0] in camera_frames:
            return EGO_FRAMES[0]
        self.notes.append(
            f'no frame is named {" or ".join(EGO_FRAMES[:2])}: "{common[0]}" is taken as the frame of the vehicle '
            "(ego_frame in --topics FILE.toml states another)"
        )
        return common[0]

    def _ego_from(self, frame: str, camera: str) -> Array:
        found = self._tree.between(self.ego_frame, frame)
        if found is None:
            frames = ", ".join(self._tree.frames[:12]) or "none"
            raise InputError(
                f'{self._bag.path}: camera {camera}: no transform leads from its frame "{frame}" to "{self.ego_frame}" '
                f"(frames: {frames}; {self._finder.seen()}): pass --calibration FILE, or name the frames with --topics "
                "FILE.toml"
            )
        if abs(found[2, 2]) > 0.7:
            self.notes.append(
                f'camera {camera}: it looks up or down, if "{frame}" is an optical frame (z ahead, x right): if it is '
                "not, name the optical frame with --topics FILE.toml"
            )
        return found

    def _camera(self, topics: CameraTopics, info: CameraInfo, ego_from_camera: Array) -> Camera:
        if topics.is_rectified and info.rectified_intrinsics is not None:
            ego_from_camera = ego_from_camera @ rigid((0, 0, 0), info.rectified_from_camera.T)
            return Camera(topics.camera, info.width, info.height, info.rectified_intrinsics, ego_from_camera)
        lens = None if topics.is_rectified else info.distortion
        return Camera(topics.camera, info.width, info.height, info.intrinsics, ego_from_camera, lens)


@dataclass(frozen=True)
class _Motion:
    """Where the poses come from. poses: None without any. source: the topic, "" if it is none."""

    poses: EgoMotion | BagEgoMotion | None
    source: str
    notes: tuple[str, ...] = ()


def _find_motion(
    bag: Bag,
    finder: TopicFinder,
    stated: StatedTopics,
    tree: TransformTree,
    reader: _RigReader,
    use: EgoMotionUse,
    file: Path | None,
) -> _Motion:
    if use == "static":
        return _Motion(None, "", ("the vehicle is assumed to stand still (poses in the bag are not read)",))
    if file is not None:
        return _Motion(read_ego_motion(file), "")
    ego_frame = reader.ego_frame or next((name for name in EGO_FRAMES if name in tree.frames), EGO_FRAMES[0])
    topic = finder.pose_topic()
    if topic is not None:
        child = pose_of(bag.message(topic, 0)).child
        child_from_ego = tree.between(child, ego_frame) if child and child != ego_frame else None
        notes: tuple[str, ...] = ()
        if child and child != ego_frame and child_from_ego is None:
            notes = (f'{topic} has poses of "{child}", which are taken as those of "{ego_frame}"',)
        return _Motion(motion_from_poses(bag, topic, child_from_ego), topic, notes)
    changing = [name for name in finder.of_kind("transforms") if not is_static(name)]
    _, sampled = sampled_transforms(bag, changing)
    moving = {one.child for one in sampled}
    path = tree.path_up(ego_frame)
    if stated.world_frame in path:
        path = path[: path.index(stated.world_frame) + 1]
    while len(path) > 1 and path[-2] not in moving:  # static links above the topmost moving one only move the world
        path.pop()
    while len(path) > 1 and path[0] not in moving:  # static links below the lowest moving one
        path.pop(0)
    if len(path) > 1 and all(frame in moving for frame in path[:-1]):
        child_from_ego = None if path[0] == ego_frame else tree.between(path[0], ego_frame)
        poses = motion_from_transforms(bag, changing, path[::-1], child_from_ego)
        return _Motion(poses, changing[0])
    if use == "required":
        raise InputError(
            f"{bag.path}: has no poses of the vehicle: no Odometry or PoseStamped, and no transform that moves "
            f'"{ego_frame}" ({finder.seen()}): pass --ego-motion FILE, --static if the vehicle stands, or '
            "--no-temporal to run without history"
        )
    return _Motion(None, "", ("the bag has no poses of the vehicle: boxes are in the ego frame",))


def _entries(bag: Bag, cameras: tuple[CameraTopics, ...]) -> tuple[FrameEntry, ...]:
    """One frame for each image of the camera with the lowest rate, with the other cameras' nearest images."""
    times = {one.camera: capture_times(bag, one.images) for one in cameras}
    periods = {name: _period_ns(own) for name, own in times.items()}
    slowest = max(periods.values())
    leading = next(name for name, period in periods.items() if period >= SAME_RATE * slowest)
    makers = {one.camera: _source_maker(bag, one) for one in cameras}
    topics = {one.camera: one.images for one in cameras}
    entries: list[FrameEntry] = []
    last = None
    for place, time in enumerate(times[leading].tolist()):
        if last is not None and time <= last:
            continue  # a message that was recorded twice
        last = time
        sources: dict[str, Source] = {}
        dropped = {}
        for name, own in times.items():
            index = place if name == leading else _nearest(own, time)
            if abs(int(own[index]) - time) > 0.501 * periods[name]:
                dropped[name] = f"{topics[name]} has no image within {periods[name] / 2e6:.0f} ms of {time} ns"
            else:
                sources[name] = makers[name](index, int(own[index]))
        origin = f"{bag.path}: {topics[leading]}: message {place}"
        entries.append(FrameEntry(FrameStamp(len(entries), "", time), sources, dropped, origin))
    return tuple(entries)


def _source_maker(bag: Bag, topics: CameraTopics) -> Callable[[int, int], Source]:
    if topics.is_video:
        return BagVideo(bag, topics.images).image
    return lambda index, time: BagImage(bag, topics.images, index, time)


def _covered(
    entries: tuple[FrameEntry, ...], motion: EgoMotion | BagEgoMotion | None, path: Path
) -> tuple[FrameEntry, ...]:
    """The frames with poses around all of their images. Localisation often starts later than the cameras."""
    if motion is None:
        return entries
    first, last = motion.first_ns - TOLERANCE_NS, motion.last_ns + TOLERANCE_NS
    kept = tuple(
        entry
        for entry in entries
        if all(first <= time <= last for time in (entry.stamp.timestamp_ns, *_source_times(entry)))
    )
    if not kept:
        begin, end = entries[0].stamp.timestamp_ns, entries[-1].stamp.timestamp_ns
        raise InputError(
            f"{path}: the poses ({motion.first_ns} to {motion.last_ns} ns) and the images ({begin} to {end} ns) do not "
            "overlap in time: pass --ego-motion FILE for these images"
        )
    return kept


def _source_times(entry: FrameEntry) -> list[int]:
    return [source.timestamp_ns for source in entry.sources.values()]


def _coverage_notes(total: int, kept: int) -> tuple[str, ...]:
    return (
        (f"{total - kept} of {total} frames are left out: there are no poses at their times",) if kept < total else ()
    )


def _period_ns(times: NDArray[np.int64]) -> float:
    """The median time between images; a second for a single one."""
    return float(np.median(np.diff(times))) if len(times) > 1 else 1e9


def _nearest(times: NDArray[np.int64], time: int) -> int:
    later = int(np.clip(np.searchsorted(times, time), 1, max(len(times) - 1, 1)))
    if len(times) == 1:
        return 0
    return later if times[later] - time < time - times[later - 1] else later - 1
