"""The vehicle of a bag: its rig, its poses from a topic or from transforms, its place on Earth; the times of images."""

import contextlib
from collections.abc import Iterable, Mapping, Sequence
from functools import partial, reduce
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.geometry.cameras import Camera, CameraRig, default_ego_from_bev
from bevcli.geometry.ego_motion import EgoMotion, derive_kinematics
from bevcli.geometry.transforms import Array, GeoOrigin, Pose, inverse, rigid
from bevcli.parsing.files import MIB
from bevcli.sequences.options import EgoMotionUse
from bevcli.workshop.formats.ros.bag import Bag, CameraTopics, StatedTopics, TopicFinder, spread
from bevcli.workshop.formats.ros.messages import Transform, camera_of, frame_of, pose_of, timestamp_ns, transforms_of

SAMPLED_MESSAGES = 200  # from the start of each topic with transforms: enough to see every frame once
MOST_MESSAGES = 8192  # of a topic, while a frame has had no valid transform
READ_WHOLE = 2048 * MIB  # of larger bags, not the times of all images are read
KINEMATICS_STEP_NS = 50_000_000  # poses closer than this in time are thinned before they are differentiated
SAMPLES = 5  # images of a topic
LARGEST_SPREAD_NS = 50_000_000  # of the delay between capture and recording, among the samples
FIX_TYPES = ("sensor_msgs/NavSatFix", "foxglove/LocationFix")
FIXES_TRIED = 50
MAX_OFFSET_M = 10_000.0  # from the world's origin; GeoOrigin counts the Earth as flat around it
# Usual names of the frame of the vehicle, and of the world.
EGO_FRAMES = ("base_link", "base_footprint", "ego_vehicle", "ego", "vehicle", "vehicle_frame", "chassis")


class TransformTree:
    """Frames and the transforms between them, each frame with one parent. The first transform of a frame counts."""

    def __init__(self, transforms: Iterable[Transform] = ()) -> None:
        self._parents: dict[str, tuple[str, Array]] = {}
        for transform in transforms:
            if transform.child != transform.parent and transform.parent_from_child is not None:
                self._parents.setdefault(transform.child, (transform.parent, transform.parent_from_child.matrix))

    @property
    def frames(self) -> list[str]:
        """Names of all frames, sorted."""
        return sorted({*self._parents, *(parent for parent, _ in self._parents.values())})

    def between(self, a: str, b: str) -> Array | None:
        """(4, 4) a_from_b in metres, None if the tree does not connect the frames."""
        up_a, up_b = self.up(a), self.up(b)
        common = next((frame for frame in up_b if frame in up_a), None)
        return None if common is None else inverse(up_a[common]) @ up_b[common]

    def up(self, frame: str) -> dict[str, Array]:
        """(4, 4) ancestor_from_frame of a frame and of its ancestors, the root last."""
        ancestors = {frame: rigid()}
        while frame in self._parents and self._parents[frame][0] not in ancestors:
            parent, parent_from_child = self._parents[frame]
            ancestors[parent] = parent_from_child @ ancestors[frame]
            frame = parent
        return ancestors


def read_transforms(bag: Bag, topic: str, number: int) -> list[Transform]:
    """The transforms of a message of a topic, or its pose. Raises InputError if it is broken."""
    return bag.read(topic, number, lambda message: [*transforms_of(message)], "a pose")


def is_static(topic: str) -> bool:
    """True for a topic with transforms that never change."""
    return topic.rstrip("/").endswith("static")


def sampled_transforms(bag: Bag, topics: Iterable[str]) -> tuple[list[Transform], list[Transform], list[str]]:
    """Static transforms, the first ones of the topics with transforms that change, and notes.

    More messages are read while a frame has had no valid transform.
    """
    static: list[Transform] = []
    changing: list[Transform] = []
    notes: list[str] = []
    for topic in topics:
        transforms: list[Transform] = []
        for number in range(min(len(bag.times(topic)), MOST_MESSAGES)):
            if number and number % SAMPLED_MESSAGES == 0:
                valid = {transform.child for transform in transforms if transform.parent_from_child is not None}
                if valid.issuperset(transform.child for transform in transforms):
                    break
            transforms += read_transforms(bag, topic, number)
        if is_static(topic):
            notes += invalid_note(topic, [transform.parent_from_child is not None for transform in transforms])
        (static if is_static(topic) else changing).extend(transforms)
    return static, changing, notes


def invalid_note(source: str, are_valid: list[bool]) -> list[str]:
    """A note on the poses that are left out; none where all are valid."""
    invalid, reason = are_valid.count(False), "NaN, a rotation that is not a quaternion of norm 1, or a broken message"
    return [f"{source}: {invalid} of {len(are_valid)} poses are left out: {reason}"] if invalid else []


def read_motion(
    bag: Bag, topics: Sequence[str], frames: Sequence[str], child_from_ego: Array | None
) -> tuple[EgoMotion, list[str]]:
    """The poses of the vehicle in topics, and notes: of Odometry or poses, or along a chain of transforms.

    frames: of the chain, that of the world first, each the parent of the next; none for a topic with poses.
    child_from_ego: (4, 4) from the last of them, or what has the poses, to the vehicle; None if they are the same.
    """
    by_child = {child: f"{parent} to {child}" for parent, child in pairwise(frames)}
    links = [*by_child.values()] or [*topics]
    samples: dict[str, dict[int, Pose]] = {link: {} for link in links}
    are_valid: list[bool] = []
    for time, topic, number in _in_order(bag, {topic: range(len(bag.times(topic))) for topic in topics}):
        try:
            transforms = read_transforms(bag, topic, number)
        except InputError:
            are_valid.append(False)
            continue
        for transform in transforms:
            link = by_child.get(transform.child) if frames else links[0]
            if link is None:
                continue
            are_valid.append(transform.parent_from_child is not None)
            if transform.parent_from_child is not None:
                samples[link][transform.timestamp_ns or time] = transform.parent_from_child
    source = " and ".join(topics)
    parts = [_motion(sorted(samples_of_link.items())) for samples_of_link in samples.values() if samples_of_link]
    first, last = max((part.first_ns for part in parts), default=0), min((part.last_ns for part in parts), default=0)
    if len(parts) < len(links) or first > last:
        raise InputError(f"{bag.path}: {source}: has no poses of {' and '.join(links)}")
    notes = invalid_note(source, are_valid)
    if len(parts) == 1 and child_from_ego is None:
        return parts[0], notes  # with the sign of the quaternion as stated
    times = np.unique(np.concatenate([part.timestamps_ns for part in parts]))
    ego = [] if child_from_ego is None else [child_from_ego]
    chains = (
        (time, [*(part.pose_at(time).matrix for part in parts), *ego])
        for time in times[(times >= first) & (times <= last)].tolist()
    )
    return _motion([(time, Pose.from_matrix(reduce(np.matmul, chain))) for time, chain in chains]), notes


def _motion(samples: Sequence[tuple[int, Pose]]) -> EgoMotion:
    """samples: times in ns and poses.

    Kinematics come from poses at least KINEMATICS_STEP_NS apart, because differences of close poses are noise.
    """
    times = np.array([time for time, _ in samples], dtype=np.int64)
    translations = np.stack([pose.translation for _, pose in samples])
    quaternions = np.stack([pose.quaternion for _, pose in samples])
    kept = [0]
    for index, time in enumerate(times.tolist()):
        if time - times[kept[-1]] >= KINEMATICS_STEP_NS:
            kept.append(index)
    seconds = (times - times[0]) / 1e9
    kinematics = (
        np.stack([np.interp(seconds, seconds[kept], column) for column in values.T], axis=-1)
        for values in derive_kinematics(times[kept], translations[kept], quaternions[kept])
    )
    return EgoMotion(times, translations, quaternions, *kinematics, velocities_are_stated=False)


def capture_times(bag: Bag, topics: Iterable[str]) -> dict[str, tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """By topic of images, (N,) times at which they were captured, ns, in order; and (N,) the numbers of the messages.

    The index of a bag has the times of recording only, in another order where messages were late. So all messages are
    read. Of a bag above READ_WHOLE, the delay is taken from a few messages; if it differs much among them, such as in
    a bag that was replayed at another speed, all messages are read, too.
    """
    logged = {topic: bag.times(topic) for topic in topics}
    numbers = {topic: range(len(log)) for topic, log in logged.items()}
    samples = numbers if bag.size <= READ_WHOLE else {topic: spread(len(log), SAMPLES) for topic, log in logged.items()}
    headers = _stated_times(bag, samples)
    captured_and_order = {}
    for topic, log in logged.items():
        delays = [time - int(log[number]) for number, time in headers[topic].items() if time] or [0]
        if max(delays) - min(delays) > LARGEST_SPREAD_NS and len(headers[topic]) < len(log):
            headers |= _stated_times(bag, {topic: numbers[topic]})
        captured = log + int(np.median(delays))
        if len(headers[topic]) == len(log):
            captured = np.array([headers[topic][number] or rough for number, rough in enumerate(captured)], np.int64)
        order = np.argsort(captured, kind="stable")
        captured_and_order[topic] = (captured[order], order)
    return captured_and_order


def _stated_times(bag: Bag, numbers: Mapping[str, Sequence[int]]) -> dict[str, dict[int, int]]:
    """The times that messages state, ns, by topic and number; 0 for none."""
    times: dict[str, dict[int, int]] = {topic: {} for topic in numbers}
    for _, topic, number in _in_order(bag, numbers):
        times[topic][number] = 0
        with contextlib.suppress(InputError, AttributeError, ValueError):
            times[topic][number] = timestamp_ns(bag.message(topic, number))
    return times


def _in_order(bag: Bag, numbers: Mapping[str, Sequence[int]]) -> list[tuple[int, str, int]]:
    """Time of recording, topic and number of messages, in the order of recording: each chunk is decompressed once."""
    logged = {topic: bag.times(topic).tolist() for topic in numbers}
    return sorted((logged[topic][number], topic, number) for topic, listed in numbers.items() for number in listed)


def find_geo_origin(bag: Bag, motion: EgoMotion | None) -> GeoOrigin | None:
    """The place of the world frame on Earth: the first valid NavSatFix, at the vehicle's place at its time.

    The world's x axis is taken as east and y as north, as ROS's REP 103 and 105 say of a map frame. The antenna counts
    as the vehicle's origin. None without poses, without a valid position, or if the vehicle is too far from the
    world's origin.
    """
    topics = [name for name, topic in bag.topics.items() if topic.short_type in FIX_TYPES and len(bag.times(name))]
    if motion is None or not topics:
        return None
    times = bag.times(topics[0])
    for index in spread(len(times), FIXES_TRIED):
        time = int(times[index])
        if not motion.first_ns <= time <= motion.last_ns:
            continue
        fix = bag.message(topics[0], index)
        degrees = np.array([fix.latitude, fix.longitude], dtype=np.float64)
        is_valid = getattr(getattr(fix, "status", None), "status", 0) >= 0
        if not (is_valid and np.isfinite(degrees).all() and np.any(degrees)):
            continue
        position = motion.pose_at(time).translation
        if np.linalg.norm(position[:2]) > MAX_OFFSET_M:
            return None
        latitude, longitude = GeoOrigin(*degrees.tolist()).latitude_longitude(-position)
        return GeoOrigin(float(latitude), float(longitude))
    return None


class VehicleReader:
    """Reads the rig of a bag, from CameraInfo and the transforms to the vehicle, and the vehicle's poses."""

    def __init__(self, bag: Bag, finder: TopicFinder, stated_topics: StatedTopics) -> None:
        self._bag, self._finder, self._topics = bag, finder, stated_topics
        static, changing, self.notes = sampled_transforms(bag, finder.of_kind("transforms"))
        self._tree, self._moving = TransformTree([*static, *changing]), {transform.child for transform in changing}
        self.ego_frame = stated_topics.ego_frame

    def rig(self) -> CameraRig:
        """The cameras, in order of their names as found. Raises InputError if intrinsics or extrinsics are missing."""
        cameras = self._finder.cameras
        frames = {camera.camera: self._topics.frames.get(camera.camera) or self._frame_of(camera) for camera in cameras}
        self.ego_frame = self.ego_frame or self._find_ego_frame(list(frames.values()))
        placed = tuple(self._camera(camera, self._ego_from(frames[camera.camera], camera.camera)) for camera in cameras)
        return CameraRig(placed, default_ego_from_bev(), ego_from_bev_assumed=True)

    def _frame_of(self, topics: CameraTopics) -> str:
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
        """The frame of the vehicle: a usual name above the one that a pose topic names, or else this one.

        Where it is the frame of a camera, or none is named, it is a usual name, or the root of all cameras.
        """
        above = [self._tree.up(frame) for frame in camera_frames]
        pose = self._finder.pose_topic()
        named = self._child_of(pose) if pose else ""
        usual = [name for name in self._tree.up(named) if name in EGO_FRAMES]
        for name in (*usual, "" if named in camera_frames else named, *EGO_FRAMES):
            if name and name in self._tree.frames:
                return name
        common = [frame for frame in above[0] if all(frame in path for path in above)]
        if not common or common[0] in camera_frames:
            return EGO_FRAMES[0]
        self.notes.append(
            f'no frame is named {" or ".join(EGO_FRAMES[:2])}: "{common[0]}" is taken as the frame of the vehicle '
            "(ego_frame in `topics_file` (`--topics FILE.toml`) states another)"
        )
        return common[0]

    def _child_of(self, topic: str) -> str:
        return self._bag.first(topic, lambda message: pose_of(message).child, "a pose")

    def _ego_from(self, frame: str, camera: str) -> Array:
        ego_from_frame = self._tree.between(self.ego_frame, frame)
        if ego_from_frame is None:
            frames = ", ".join(self._tree.frames[:12]) or "none"
            raise InputError(
                f'{self._bag.path}: camera {camera}: no transform leads from its frame "{frame}" to "{self.ego_frame}" '
                f"(frames: {frames}; {self._finder.seen()}): pass `calibration` (`--calibration FILE`), or name the "
                "frames with `topics_file` (`--topics FILE.toml`)"
            )
        if abs(ego_from_frame[2, 2]) > 0.7:
            self.notes.append(
                f'camera {camera}: it looks up or down, if "{frame}" is an optical frame (z ahead, x right): if it is '
                "not, name the optical frame with `topics_file` (`--topics FILE.toml`)"
            )
        return ego_from_frame

    def motion(self, use: EgoMotionUse) -> tuple[EgoMotion | None, str, tuple[str, ...]]:
        """The poses of a topic or the transforms, None without any; their topic, "" for none; and notes.

        Raises InputError if poses are required and not found.
        """
        if use == "static":
            return None, "", ("the vehicle is assumed to stand still (poses in the bag are not read)",)
        ego_frame = self.ego_frame or next((name for name in EGO_FRAMES if name in self._tree.frames), EGO_FRAMES[0])
        topic = self._finder.pose_topic()
        if topic is not None:
            child = self._child_of(topic)
            is_other = child not in ("", ego_frame)
            child_from_ego = self._tree.between(child, ego_frame) if is_other else None
            note = f'{topic} has poses of "{child}", which are taken as those of "{ego_frame}"'
            motion, notes = read_motion(self._bag, [topic], [], child_from_ego)
            return motion, topic, (*([note] if is_other and child_from_ego is None else ()), *notes)
        path = self._moving_path(ego_frame)
        if len(path) > 1:
            changing = [name for name in self._finder.of_kind("transforms") if not is_static(name)]
            child_from_ego = None if path[0] == ego_frame else self._tree.between(path[0], ego_frame)
            motion, notes = read_motion(self._bag, changing, path[::-1], child_from_ego)
            return motion, changing[0], tuple(notes)
        if use == "required":
            raise InputError(
                f"{self._bag.path}: has no poses of the vehicle: no Odometry or PoseStamped, and no transform that "
                f'moves "{ego_frame}" ({self._finder.seen()}): pass `ego_motion_file` (`--ego-motion FILE`), '
                "`odometry=True` (`--odometry`) to measure them from the images, "
                '`ego_motion="static"` (`--static`) if the vehicle stands, or '
                "`temporal=False` (`--no-temporal`) to run without history"
            )
        note = "the bag has no poses of the vehicle: boxes are in the ego frame"
        return None, "", () if use == "measured" else (note,)

    def _moving_path(self, ego_frame: str) -> list[str]:
        """Frames from the vehicle's to the world's, with links that move; a single one if there are none."""
        path = list(self._tree.up(ego_frame))
        if self._topics.world_frame in path:
            path = path[: path.index(self._topics.world_frame) + 1]
        moving = [index for index, frame in enumerate(path[:-1]) if frame in self._moving]
        # Static links above the topmost moving one only move the world; those below the lowest belong to the vehicle.
        path = path[moving[0] : moving[-1] + 2] if moving else path[:1]
        return path if len(path) == len(moving) + 1 else path[:1]
