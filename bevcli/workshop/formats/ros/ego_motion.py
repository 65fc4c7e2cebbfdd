"""The vehicle's poses in a bag, from a topic with poses or from transforms, and the times of its images."""

import contextlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import reduce
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.geometry.ego_motion import EgoMotion, derive_kinematics
from bevcli.geometry.transforms import Array, GeoOrigin, Pose, inverse, rigid
from bevcli.parsing.files import MIB
from bevcli.workshop.formats.ros.bag import Bag, spread
from bevcli.workshop.formats.ros.messages import Transform, timestamp_ns, transforms_of

SAMPLED_MESSAGES = 200  # from the start of each topic with transforms: enough to see every frame once
MOST_MESSAGES = 8192  # of a topic, while a frame has had no valid transform
READ_WHOLE = 2048 * MIB  # of larger bags, not the times of all images are read
KINEMATICS_STEP_NS = 50_000_000  # poses closer than this in time are thinned before they are differentiated
SAMPLES = 5  # images of a topic
LARGEST_SPREAD_NS = 50_000_000  # of the delay between capture and recording, among the samples
FIX_TYPES = ("sensor_msgs/NavSatFix", "foxglove/LocationFix")
FIXES_TRIED = 50
MAX_OFFSET_M = 10_000.0  # from the world's origin; GeoOrigin counts the Earth as flat around it


class TransformTree:
    """Frames and the transforms between them, each frame with one parent. The first transform of a frame counts."""

    def __init__(self, transforms: Iterable[Transform] = ()) -> None:
        self._parents: dict[str, tuple[str, Array]] = {}
        for one in transforms:
            if one.child != one.parent and one.parent_from_child is not None:
                self._parents.setdefault(one.child, (one.parent, one.parent_from_child.matrix))

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
        found = {frame: rigid()}
        while frame in self._parents and self._parents[frame][0] not in found:
            parent, parent_from_child = self._parents[frame]
            found[parent] = parent_from_child @ found[frame]
            frame = parent
        return found


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
        found: list[Transform] = []
        for number in range(min(len(bag.times(topic)), MOST_MESSAGES)):
            if number and number % SAMPLED_MESSAGES == 0:
                valid = {one.child for one in found if one.parent_from_child is not None}
                if valid.issuperset(one.child for one in found):
                    break
            found += read_transforms(bag, topic, number)
        if is_static(topic):
            notes += invalid_note(topic, [one.parent_from_child is not None for one in found])
        (static if is_static(topic) else changing).extend(found)
    return static, changing, notes


def invalid_note(source: str, are_valid: list[bool]) -> list[str]:
    """A note on the poses that are left out; none where all are valid."""
    invalid, reason = are_valid.count(False), "NaN, a rotation that is not a quaternion of norm 1, or a broken message"
    return [f"{source}: {invalid} of {len(are_valid)} poses are left out: {reason}"] if invalid else []


def motion_from_poses(bag: Bag, topic: str, child_from_ego: Array | None) -> tuple[EgoMotion, list[str]]:
    """Poses of a topic with Odometry or poses, and notes. child_from_ego: (4, 4), None: the poses are the vehicle's."""
    return _motion_from(bag, [topic], [topic], lambda one: topic, child_from_ego)


def motion_from_transforms(
    bag: Bag, topics: Sequence[str], frames: Sequence[str], child_from_ego: Array | None
) -> tuple[EgoMotion, list[str]]:
    """Poses along a chain of transforms, and notes. topics: with transforms that change.

    frames: the frame of the world first, each the parent of the next. child_from_ego: (4, 4) from the last of them to
    the ego vehicle, None if they are the same.
    """
    links = [f"{parent} to {child}" for parent, child in pairwise(frames)]
    by_child = dict(zip(frames[1:], links, strict=True))
    return _motion_from(bag, topics, links, lambda one: by_child.get(one.child), child_from_ego)


def _motion_from(
    bag: Bag,
    topics: Sequence[str],
    links: Sequence[str],
    link_of: Callable[[Transform], str | None],
    child_from_ego: Array | None,
) -> tuple[EgoMotion, list[str]]:
    """Poses along links, which are multiplied, and notes. link_of: the link of a transform, None for none of them."""
    samples: dict[str, dict[int, Pose]] = {link: {} for link in links}
    are_valid: list[bool] = []
    for time, topic, number in _in_order(bag, {topic: range(len(bag.times(topic))) for topic in topics}):
        try:
            stated = [(link, one) for one in read_transforms(bag, topic, number) if (link := link_of(one))]
        except InputError:
            are_valid.append(False)
            continue
        for link, one in stated:
            are_valid.append(one.parent_from_child is not None)
            if one.parent_from_child is not None:
                samples[link][one.timestamp_ns or time] = one.parent_from_child
    source = " and ".join(topics)
    parts = [_motion(sorted(own.items())) for own in samples.values() if own]
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
    for place, time in enumerate(times.tolist()):
        if time - times[kept[-1]] >= KINEMATICS_STEP_NS:
            kept.append(place)
    seconds = (times - times[0]) / 1e9
    kinematics = (
        np.stack([np.interp(seconds, seconds[kept], column) for column in part.T], axis=-1)
        for part in derive_kinematics(times[kept], translations[kept], quaternions[kept])
    )
    return EgoMotion(times, translations, quaternions, *kinematics, velocities_are_stated=False)


def capture_times(bag: Bag, topics: Iterable[str]) -> dict[str, tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """By topic of images, (N,) times at which they were captured, ns, in order; and (N,) the numbers of the messages.

    The index of a bag has the times of recording only, in another order where messages were late. So all messages are
    read. Of a bag above READ_WHOLE, the delay is taken from a few messages; if it differs much among them, such as in
    a bag that was replayed at another speed, all messages are read, too.
    """
    logged = {topic: bag.times(topic) for topic in topics}
    numbers = {topic: range(len(own)) for topic, own in logged.items()}
    samples = numbers if bag.size <= READ_WHOLE else {topic: spread(len(own), SAMPLES) for topic, own in logged.items()}
    stated = _stated_times(bag, samples)
    found = {}
    for topic, own in logged.items():
        delays = [time - int(own[number]) for number, time in stated[topic].items() if time] or [0]
        if max(delays) - min(delays) > LARGEST_SPREAD_NS and len(stated[topic]) < len(own):
            stated |= _stated_times(bag, {topic: numbers[topic]})
        captured = own + int(np.median(delays))
        if len(stated[topic]) == len(own):
            captured = np.array([stated[topic][number] or rough for number, rough in enumerate(captured)], np.int64)
        order = np.argsort(captured, kind="stable")
        found[topic] = (captured[order], order)
    return found


def _stated_times(bag: Bag, numbers: Mapping[str, Sequence[int]]) -> dict[str, dict[int, int]]:
    """The times that messages state, ns, by topic and number; 0 for none."""
    found: dict[str, dict[int, int]] = {topic: {} for topic in numbers}
    for _, topic, number in _in_order(bag, numbers):
        found[topic][number] = 0
        with contextlib.suppress(InputError, AttributeError, ValueError):
            found[topic][number] = timestamp_ns(bag.message(topic, number))
    return found


def _in_order(bag: Bag, numbers: Mapping[str, Sequence[int]]) -> list[tuple[int, str, int]]:
    """Time of recording, topic and number of messages, in the order of recording: each chunk is decompressed once."""
    logged = {topic: bag.times(topic).tolist() for topic in numbers}
    return sorted((logged[topic][number], topic, number) for topic, own in numbers.items() for number in own)


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
        position = np.array([fix.latitude, fix.longitude], dtype=np.float64)
        is_valid = getattr(getattr(fix, "status", None), "status", 0) >= 0
        if not (is_valid and np.isfinite(position).all() and np.any(position)):
            continue
        place = motion.pose_at(time).translation
        if np.linalg.norm(place[:2]) > MAX_OFFSET_M:
            return None
        latitude, longitude = GeoOrigin(*position.tolist()).latitude_longitude(-place)
        return GeoOrigin(float(latitude), float(longitude))
    return None
