"""A ROS 2 bag or an MCAP file as a Sequence."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.frame import DriveFacts, Frame, FrameStamp, Sequence
from bevcli.geometry.cameras import Camera, CameraRig, default_ego_from_bev
from bevcli.geometry.ego_motion import TOLERANCE_NS, EgoMotion
from bevcli.geometry.transforms import Array
from bevcli.parsing.files import is_there
from bevcli.sequences.files.calibration_file import read_rig_and_facts
from bevcli.sequences.images import FrameEntry, ImageReader, Source, bev_frame_notes, read_frame
from bevcli.sequences.native.tables import read_ego_motion
from bevcli.sequences.options import EgoMotionUse, SequenceOptions
from bevcli.workshop.formats.ros.bag import Bag, CameraTopics, StatedTopics, TopicFinder, read_topics_file
from bevcli.workshop.formats.ros.ego_motion import (
    TransformTree,
    capture_times,
    find_geo_origin,
    is_static,
    motion_from_poses,
    motion_from_transforms,
    sampled_transforms,
)
from bevcli.workshop.formats.ros.format import BagOptions, is_packed_bag, is_ros_bag
from bevcli.workshop.formats.ros.images import BagVideo, bag_image
from bevcli.workshop.formats.ros.messages import camera_of, frame_of, pose_of

# Usual names of the frame of the vehicle, and of the world.
EGO_FRAMES = ("base_link", "base_footprint", "ego_vehicle", "ego", "vehicle", "vehicle_frame", "chassis")
SAME_RATE = 0.98  # cameras whose rates differ by less have the same rate; the first of them leads
CALIBRATION_FILE, EGO_MOTION_FILE = "calibration.json", "ego_motion.csv"


class RosSequence(Sequence):
    """A bag as a `Sequence`. Opening it reads the index, the calibration, the poses and the times of the images.

    The camera with the lowest rate leads: each of its images is a frame, with the other cameras' nearest images.

    Raises InputError if the bag is broken, or cameras, extrinsics or poses are not found.
    """

    def __init__(self, path: Path, common: SequenceOptions = SequenceOptions(), own: BagOptions = BagOptions()) -> None:
        if path.suffix == ".bag" and not is_ros_bag(path):
            raise InputError(
                f"{path}: is a bag of ROS 1: convert it (`rosbags-convert --src {path.name} --dst {path.stem}`)"
            )
        if path.is_file() and is_packed_bag(path):
            raise InputError(f"{path}: is compressed: decompress it first (such as zstd -d {path.name})")
        stated = read_topics_file(own.topics_file, own.topics)
        rig = own.rig()
        self.path = path
        self.name = path.resolve().stem if path.is_file() else path.resolve().name
        self._bag = Bag(path)
        rig, facts, file, beside = _files_beside(path.parent if path.is_file() else path, rig, common, own)
        finder = TopicFinder(self._bag, stated, rig.names if rig else None)
        reader = _VehicleReader(self._bag, finder, stated)
        self.rig = reader.rig() if rig is None else rig
        self._motion, source, motion_notes = reader.motion(common.ego_motion, file)
        self.has_ego_motion = self._motion is not None
        self.facts = replace(facts, geo_origin=facts.geo_origin or find_geo_origin(self._bag, self._motion))
        self._entries, gaps = _covered(_entries(self._bag, finder.cameras), self._motion, path)
        self.stamps = tuple(entry.stamp for entry in self._entries)
        self.notes = (
            finder.table(source),
            *self._bag.notes,
            *beside,
            *reader.notes,
            *(f"{name} is not used: no CameraInfo belongs to it" for name in finder.left_out),
            *bev_frame_notes(self.rig, "the calibration" if rig else "a bag"),
            *motion_notes,
            *gaps,
        )
        self._images = ImageReader(strict=common.strict)

    @property
    def input_files(self) -> tuple[Path, ...]:
        return self._bag.file_paths

    def load(self, place: int) -> Frame:
        return read_frame(self._entries[place], self.rig, self._images, self._motion)


def _files_beside(
    folder: Path, rig: CameraRig | None, common: SequenceOptions, own: BagOptions
) -> tuple[CameraRig | None, DriveFacts, Path | None, list[str]]:
    """Rig, facts, ego-motion file and notes: those of files beside the bag, where no others are given."""
    calibration, notes = folder / CALIBRATION_FILE, []
    found, facts = read_rig_and_facts(calibration) if is_there(calibration) else (None, DriveFacts())
    if rig is None and found is not None:
        notes.append(f"{calibration} is used in place of the calibration in the bag")
    file = own.ego_motion_file
    if file is None and common.ego_motion != "static" and is_there(folder / EGO_MOTION_FILE):
        file = folder / EGO_MOTION_FILE
        notes.append(f"{file} is used in place of the poses in the bag")
    return found if rig is None else rig, facts, file, notes


class _VehicleReader:
    """Reads the rig of a bag, from CameraInfo and the transforms to the vehicle, and the vehicle's poses."""

    def __init__(self, bag: Bag, finder: TopicFinder, stated: StatedTopics) -> None:
        self._bag, self._finder, self._stated = bag, finder, stated
        static, changing, self.notes = sampled_transforms(bag, finder.of_kind("transforms"))
        self._tree, self._moving = TransformTree([*static, *changing]), {one.child for one in changing}
        self.ego_frame = stated.ego_frame

    def rig(self) -> CameraRig:
        """The cameras, in order of their names as found. Raises InputError if intrinsics or extrinsics are missing."""
        cameras = self._finder.cameras
        frames = {one.camera: self._stated.frames.get(one.camera) or self._frame_of(one) for one in cameras}
        self.ego_frame = self.ego_frame or self._find_ego_frame(list(frames.values()))
        found = tuple(self._camera(one, self._ego_from(frames[one.camera], one.camera)) for one in cameras)
        return CameraRig(found, default_ego_from_bev(), ego_from_bev_assumed=True)

    def _frame_of(self, topics: CameraTopics) -> str:
        """The optical frame that the images name, or else the calibration."""
        named = (
            self._bag.first(topic, frame_of, "an image or a calibration")
            for topic in (topics.images, topics.calibration)
            if topic
        )
        return next(filter(None, named), "")

    def _camera(self, topics: CameraTopics, ego_from_camera: Array) -> Camera:
        assert topics.calibration is not None
        where = f"{self._bag.path}: {topics.calibration}"
        parse = partial(
            camera_of, name=topics.camera, ego_from_camera=ego_from_camera, rectified=topics.is_rectified, where=where
        )
        return self._bag.first(topics.calibration, parse, "a calibration")

    def _find_ego_frame(self, camera_frames: list[str]) -> str:
        """The frame of the vehicle: the one that a pose topic names, a usual name, or the root of all cameras."""
        above = [self._tree.up(frame) for frame in camera_frames]
        pose = self._finder.pose_topic()
        named = self._child_of(pose) if pose else ""
        for name in (named, *EGO_FRAMES):
            if name and name in self._tree.frames:
                return name
        common = [frame for frame in above[0] if all(frame in path for path in above)]
        if not common or common[0] in camera_frames:
            return EGO_FRAMES[0]
        self.notes.append(
            f'no frame is named {" or ".join(EGO_FRAMES[:2])}: "{common[0]}" is taken as the frame of the vehicle '
            "(ego_frame in `topics_file=FILE.toml` states another)"
        )
        return common[0]

    def _child_of(self, topic: str) -> str:
        """The frame whose poses a topic has, "" if it names none."""
        return self._bag.first(topic, lambda message: pose_of(message).child, "a pose")

    def _ego_from(self, frame: str, camera: str) -> Array:
        found = self._tree.between(self.ego_frame, frame)
        if found is None:
            frames = ", ".join(self._tree.frames[:12]) or "none"
            raise InputError(
                f'{self._bag.path}: camera {camera}: no transform leads from its frame "{frame}" to "{self.ego_frame}" '
                f"(frames: {frames}; {self._finder.seen()}): pass `calibration=FILE`, or name the frames "
                "with `topics_file=FILE.toml`"
            )
        if abs(found[2, 2]) > 0.7:
            self.notes.append(
                f'camera {camera}: it looks up or down, if "{frame}" is an optical frame (z ahead, x right): if it is '
                "not, name the optical frame with `topics_file=FILE.toml`"
            )
        return found

    def motion(self, use: EgoMotionUse, file: Path | None) -> tuple[EgoMotion | None, str, tuple[str, ...]]:
        """The poses of a file, a topic or the transforms, None without any; their topic, "" for none; and notes.

        Raises InputError if poses are required and not found.
        """
        if use == "static":
            return None, "", ("the vehicle is assumed to stand still (poses in the bag are not read)",)
        if file is not None:
            return read_ego_motion(file), "", ()
        ego_frame = self.ego_frame or next((name for name in EGO_FRAMES if name in self._tree.frames), EGO_FRAMES[0])
        topic = self._finder.pose_topic()
        if topic is not None:
            child = self._child_of(topic)
            is_other = child not in ("", ego_frame)
            child_from_ego = self._tree.between(child, ego_frame) if is_other else None
            note = f'{topic} has poses of "{child}", which are taken as those of "{ego_frame}"'
            motion, notes = motion_from_poses(self._bag, topic, child_from_ego)
            return motion, topic, (*([note] if is_other and child_from_ego is None else ()), *notes)
        path = self._moving_path(ego_frame)
        if len(path) > 1:
            changing = [name for name in self._finder.of_kind("transforms") if not is_static(name)]
            child_from_ego = None if path[0] == ego_frame else self._tree.between(path[0], ego_frame)
            motion, notes = motion_from_transforms(self._bag, changing, path[::-1], child_from_ego)
            return motion, changing[0], tuple(notes)
        if use == "required":
            raise InputError(
                f"{self._bag.path}: has no poses of the vehicle: no Odometry or PoseStamped, and no transform that "
                f'moves "{ego_frame}" ({self._finder.seen()}): pass `ego_motion_file=FILE`, `ego_motion="static"` if '
                "the vehicle stands, or `temporal=False` to run without history"
            )
        return None, "", ("the bag has no poses of the vehicle: boxes are in the ego frame",)

    def _moving_path(self, ego_frame: str) -> list[str]:
        """Frames from the vehicle's to the world's, with links that move; a single one if there are none."""
        path = list(self._tree.up(ego_frame))
        if self._stated.world_frame in path:
            path = path[: path.index(self._stated.world_frame) + 1]
        moving = [place for place, frame in enumerate(path[:-1]) if frame in self._moving]
        # Static links above the topmost moving one only move the world; those below the lowest belong to the vehicle.
        path = path[moving[0] : moving[-1] + 2] if moving else path[:1]
        return path if len(path) == len(moving) + 1 else path[:1]


def _entries(bag: Bag, cameras: tuple[CameraTopics, ...]) -> tuple[FrameEntry, ...]:
    """One frame for each image of the camera with the lowest rate, with the other cameras' nearest images."""
    captured = capture_times(bag, [one.images for one in cameras])
    times = {one.camera: captured[one.images][0] for one in cameras}
    # The median time between images; a second for a single one.
    periods = {n: float(np.median(np.diff(own))) if len(own) > 1 else 1e9 for n, own in times.items()}
    slowest = max(periods.values())
    leading = next(name for name, period in periods.items() if period >= SAME_RATE * slowest)
    makers: dict[str, Callable[[int, int], Source]] = {
        one.camera: BagVideo(bag, one.images, captured[one.images][1]).image
        if one.is_video
        else partial(bag_image, bag, one.images, captured[one.images][1])
        for one in cameras
    }
    topics = {one.camera: one.images for one in cameras}
    entries: list[FrameEntry] = []
    for place, time in enumerate(times[leading].tolist()):
        if entries and time <= entries[-1].stamp.timestamp_ns:
            continue  # a message that was recorded twice
        sources: dict[str, Source] = {}
        dropped = {}
        for name, own in times.items():
            index = place if name == leading else _nearest(own, time)
            if abs(int(own[index]) - time) > 0.501 * periods[name]:
                dropped[name] = f"{topics[name]} has no image within {periods[name] / 2e6:.0f} ms of {time} ns"
            else:
                sources[name] = makers[name](index, int(own[index]))
        origin = f"{bag.path}: {topics[leading]}: message {captured[topics[leading]][1][place]}"
        entries.append(FrameEntry(FrameStamp(len(entries), "", time), sources, dropped, origin))
    return tuple(entries)


def _covered(
    entries: tuple[FrameEntry, ...], motion: EgoMotion | None, path: Path
) -> tuple[tuple[FrameEntry, ...], tuple[str, ...]]:
    """The frames with poses around all of their images, and notes. Localisation often starts later than the cameras."""
    if motion is None:
        return entries, ()
    first, last = motion.first_ns - TOLERANCE_NS, motion.last_ns + TOLERANCE_NS
    kept = tuple(
        entry
        for entry in entries
        if all(first <= one.timestamp_ns <= last for one in (entry.stamp, *entry.sources.values()))
    )
    if not kept:
        begin, end = entries[0].stamp.timestamp_ns, entries[-1].stamp.timestamp_ns
        raise InputError(
            f"{path}: the poses ({motion.first_ns} to {motion.last_ns} ns) and the images ({begin} to {end} ns) do not "
            "overlap in time: pass `ego_motion_file=FILE` for these images"
        )
    left_out = len(entries) - len(kept)
    note = f"{left_out} of {len(entries)} frames are left out: there are no poses at their times"
    return kept, (note,) if left_out else ()


def _nearest(times: NDArray[np.int64], time: int) -> int:
    later = int(np.clip(np.searchsorted(times, time), 1, max(len(times) - 1, 1)))
    if len(times) == 1:
        return 0
    return later if times[later] - time < time - times[later - 1] else later - 1
