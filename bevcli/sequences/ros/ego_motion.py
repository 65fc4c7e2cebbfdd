"""The vehicle's poses in a bag, read around a time on demand: from a topic with poses, or from transforms."""

from bisect import bisect_left
from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache, reduce
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.geometry.ego_motion import EgoMotion, Kinematics, derive_kinematics
from bevcli.geometry.geographic import GeoOrigin
from bevcli.geometry.transforms import Array, Pose, interpolate, inverse, rigid
from bevcli.parsing.files import MIB
from bevcli.sequences.ros.bag import Bag, spread
from bevcli.sequences.ros.messages import Transform, timestamp_ns, transforms_of

SAMPLED_MESSAGES = 200  # from the start of each topic with transforms: enough to see every frame once
READ_WHOLE = 2048 * MIB  # of larger bags, not the times of all messages are read
Sample = tuple[int, Pose]  # time ns, pose at that time
ReadMessage = Callable[[int], dict[str, list[Sample]]]  # message -> samples by link
MARGIN = 4  # samples on each side of a time: derivatives of second order, and one more
MESSAGES_AT_ONCE = 8
MOST_MESSAGES = 8192  # around one time; more without a pose is a gap
KINEMATICS_STEP_NS = 50_000_000  # poses closer than this in time are thinned before they are differentiated
SAMPLES = 5
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
    invalid, reason = are_valid.count(False), "NaN, or a rotation that is not a quaternion of norm 1"
    return [f"{source}: {invalid} of {len(are_valid)} poses are left out: {reason}"] if invalid else []


class BagEgoMotion:
    """The vehicle's poses in a bag, with the methods of `EgoMotion`.

    Only messages around the asked times are read. Kinematics are derived from the poses.
    """

    def __init__(
        self, times: np.ndarray, read: ReadMessage, links: Sequence[str], source: str, ego: Array | None = None
    ) -> None:
        """times: (N,) of the messages, ns. read: the samples of a message by link. links: from the world to the ego
        vehicle; their poses are multiplied. source: for error messages. ego: (4, 4) child_from_ego, None: the same.
        """
        self.notes: list[str] = []
        self._times, self._links, self._source, self._ego = times, tuple(links), source, ego
        self._read = lru_cache(maxsize=1 << 14)(read)
        self._window = lru_cache(maxsize=64)(self._read_window)
        self.first_ns = self._end(range(len(times)), max)
        self.last_ns = self._end(range(len(times) - 1, -1, -1), min)

    def pose_at(self, timestamp_ns: int) -> Pose:
        """world_from_ego at a time, interpolated. Raises InputError if there is no pose around it."""
        return self._window(timestamp_ns).pose_at(timestamp_ns)

    def kinematics_at(self, timestamp_ns: int) -> Kinematics:
        """Acceleration, angular rate and velocity at a time. Raises InputError as `pose_at`."""
        return self._window(timestamp_ns).kinematics_at(timestamp_ns)

    def _end(self, indices: range, outermost: Callable[[list[int]], int]) -> int:
        """Time of the first sample of every link from one end of the bag on."""
        found: dict[str, int] = {}
        for index in indices[:MOST_MESSAGES]:
            for link, samples in self._read(index).items():
                found.setdefault(link, samples[0][0] if indices.step > 0 else samples[-1][0])
            if len(found) == len(self._links):
                return outermost(list(found.values()))
        raise InputError(f"{self._source}: has no poses of {' and '.join(self._links)}")

    def _read_window(self, timestamp_ns: int) -> EgoMotion:
        """The poses around a time."""
        message = int(np.searchsorted(self._times, timestamp_ns))
        grow = MESSAGES_AT_ONCE
        low, high = message - grow, message + grow
        while True:
            indices = range(max(low, 0), min(high, len(self._times)))
            samples = self._samples(indices)
            times = [time for time, _ in max(samples.values(), key=len)]
            has_all = all(samples.values())
            before = has_all and _reaches(times[::-1], timestamp_ns, -1)
            after = has_all and _reaches(times, timestamp_ns, 1)
            is_complete = (before or indices.start == 0) and (after or indices.stop == len(self._times))
            if is_complete or len(indices) > MOST_MESSAGES:
                break
            low, high = low - (0 if before else grow), high + (0 if after else grow)
            grow *= 2
        if not has_all:
            raise InputError(f"{self._source}: has no pose around {timestamp_ns} ns")
        return self._motion(samples, times)

    def _samples(self, indices: range) -> dict[str, list[Sample]]:
        """Samples by link, in order of time, one a time."""
        found: dict[str, dict[int, Pose]] = {link: {} for link in self._links}
        for index in indices:
            for link, samples in self._read(index).items():
                found[link].update(samples)
        return {link: sorted(by_time.items(), key=lambda sample: sample[0]) for link, by_time in found.items()}

    def _motion(self, samples: dict[str, list[Sample]], times: list[int]) -> EgoMotion:
        if len(self._links) == 1 and self._ego is None:
            poses = [pose for _, pose in samples[self._links[0]]]  # with the sign of the quaternion as stated
        else:
            last = [] if self._ego is None else [self._ego]
            chains = ([*(_at(samples[link], time).matrix for link in self._links), *last] for time in times)
            poses = [Pose.from_matrix(reduce(np.matmul, chain, np.eye(4))) for chain in chains]
        stamps = np.array(times, dtype=np.int64)
        translations = np.stack([pose.translation for pose in poses])
        quaternions = np.stack([pose.quaternion for pose in poses])
        return EgoMotion(stamps, translations, quaternions, *_kinematics(stamps, translations, quaternions))


def _reaches(times: list[int], timestamp_ns: int, sign: int) -> bool:
    """True if enough samples lie on one side of a time for derivatives there. times: the outermost last."""
    beyond = [time for time in times if sign * (time - timestamp_ns) >= 0]
    return len(beyond) > MARGIN and sign * (beyond[-1] - timestamp_ns) >= MARGIN * KINEMATICS_STEP_NS


def motion_from_poses(bag: Bag, topic: str, child_from_ego: Array | None) -> BagEgoMotion:
    """Poses of a topic with Odometry or poses. child_from_ego: (4, 4) from the frame of the poses, None: the same."""
    return _motion_from(bag, [topic], [topic], lambda one: topic, child_from_ego)


def motion_from_transforms(
    bag: Bag, topics: Sequence[str], frames: Sequence[str], child_from_ego: Array | None
) -> BagEgoMotion:
    """Poses along a chain of transforms. topics: with transforms that change.

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
) -> BagEgoMotion:
    """Poses along links. link_of: the link that a transform states, None for none of them."""
    are_valid: list[bool] = []

    def seen(message: Any) -> None:
        are_valid.extend(one.parent_from_child is not None for one in transforms_of(message) if link_of(one))

    parts = capture_times(bag, topics, seen)
    places = [(topic, number) for topic, (_, numbers) in parts.items() for number in numbers.tolist()]
    times = np.concatenate([times for times, _ in parts.values()])
    order = np.argsort(times, kind="stable")
    times = times[order]

    def read(index: int) -> dict[str, list[Sample]]:
        found: dict[str, list[Sample]] = {}
        for one in read_transforms(bag, *places[order[index]]):
            link = link_of(one)
            if link is not None and one.parent_from_child is not None:
                found.setdefault(link, []).append((one.timestamp_ns or int(times[index]), one.parent_from_child))
        return found

    source = " and ".join(topics)
    motion = BagEgoMotion(times, read, links, f"{bag.path}: {source}", child_from_ego)
    motion.notes += invalid_note(source, are_valid)
    return motion


def _at(samples: list[Sample], time: int) -> Pose:
    """The pose of one link at a time; outside of its samples, the nearest."""
    times = [stamp for stamp, _ in samples]
    later = bisect_left(times, time)
    if later in (0, len(times)) or times[later] == time:
        return samples[min(later, len(times) - 1)][1]
    earlier = later - 1
    fraction = (time - times[earlier]) / (times[later] - times[earlier])
    return interpolate(samples[earlier][1], samples[later][1], fraction)


def _kinematics(times: np.ndarray, translations: Array, quaternions: Array) -> tuple[Array, Array, Array]:
    """Derived from poses at least KINEMATICS_STEP_NS apart, because differences of close poses are noise."""
    kept = [0]
    for place in range(1, len(times)):
        if times[place] - times[kept[-1]] >= KINEMATICS_STEP_NS:
            kept.append(place)
    derived = derive_kinematics(times[kept], translations[kept], quaternions[kept])
    seconds = (times - times[0]) / 1e9
    return tuple(  # type: ignore[return-value]
        np.stack([np.interp(seconds, seconds[kept], column) for column in part.T], axis=-1) for part in derived
    )


def capture_times(
    bag: Bag, topics: Iterable[str], seen: Callable[[Any], None] = lambda message: None
) -> dict[str, tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """By topic, (N,) times at which its messages were captured, ns, in order; and (N,) their numbers.

    The index of a bag has the times of recording only, in another order where messages were late. So all messages are
    read. Of a bag above READ_WHOLE, the delay is taken from a few messages; if it differs much among them, such as in
    a bag that was replayed at another speed, all messages are read, too. seen: is called with the messages read.
    """

    def stated(topic: str, number: int) -> int:
        try:
            message = bag.message(topic, number)
            seen(message)
            return timestamp_ns(message) or next((one.timestamp_ns for one in transforms_of(message)), 0)
        except (InputError, AttributeError, ValueError):
            return 0

    logged = {topic: bag.times(topic) for topic in topics}
    is_small = bag.size <= READ_WHOLE
    numbers = {topic: range(len(own)) if is_small else spread(len(own), SAMPLES) for topic, own in logged.items()}
    # In the order of recording, so that each chunk is decompressed once.
    places = sorted((int(own[number]), topic, number) for topic, own in logged.items() for number in numbers[topic])
    times = {(topic, number): stated(topic, number) for _, topic, number in places}
    found = {}
    for topic, own in logged.items():
        delays = [time - int(own[number]) for (other, number), time in times.items() if other == topic and time]
        captured = own + int(np.median(delays or [0]))
        if is_small or (delays and max(delays) - min(delays) > LARGEST_SPREAD_NS):
            exact = (times[topic, number] if is_small else stated(topic, number) for number in range(len(own)))
            captured = np.array([time or rough for time, rough in zip(exact, captured.tolist(), strict=True)], np.int64)
        order = np.argsort(captured, kind="stable")
        found[topic] = (captured[order], order)
    return found


def find_geo_origin(bag: Bag, motion: EgoMotion | BagEgoMotion | None) -> GeoOrigin | None:
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
