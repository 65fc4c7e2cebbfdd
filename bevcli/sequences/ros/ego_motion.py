"""The vehicle's poses in a bag, read around a time on demand: from a topic with poses, or from transforms."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Sequence
from functools import lru_cache
from itertools import pairwise

import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.ego_motion import EgoMotion, Kinematics, derive_kinematics
from bevcli.geometry.transforms import Array, Pose, interpolate
from bevcli.sequences.ros.bag import Bag
from bevcli.sequences.ros.capture_times import capture_times
from bevcli.sequences.ros.messages import pose_of
from bevcli.sequences.ros.transforms import read_transforms

Sample = tuple[int, Pose]  # time ns, pose at that time
ReadMessage = Callable[[int], dict[str, list[Sample]]]  # message -> samples by link
MARGIN = 4  # samples on each side of a time: derivatives of second order, and one more
MESSAGES_AT_ONCE = 8
MOST_MESSAGES = 8192  # around one time; more without a pose is a gap
KINEMATICS_STEP_NS = 50_000_000  # poses closer than this in time are thinned before they are differentiated


class BagEgoMotion:
    """The vehicle's poses in a bag, with the methods of `EgoMotion`.

    Only messages around the asked times are read. Kinematics are derived from the poses.

    Attributes:
        first_ns, last_ns: time of the first and the last pose.
    """

    def __init__(
        self, times: np.ndarray, read: ReadMessage, links: Sequence[str], source: str, ego: Array | None = None
    ) -> None:
        """times: (N,) of the messages, ns. read: the samples of a message by link. links: from the world to the ego
        vehicle; their poses are multiplied. source: for error messages. ego: (4, 4) child_from_ego, None: the same.
        """
        self._times, self._links, self._source, self._ego = times, tuple(links), source, ego
        self._read = lru_cache(maxsize=1 << 14)(read)
        self._window = lru_cache(maxsize=64)(self._read_window)
        self.first_ns = self._end(range(len(times)), max)
        self.last_ns = self._end(range(len(times) - 1, -1, -1), min)

    def pose_at(self, timestamp_ns: int) -> Pose:
        """world_from_ego at a time, interpolated. Raises InputError if there is no pose around it."""
        return self._window(self._message_at(timestamp_ns), timestamp_ns).pose_at(timestamp_ns)

    def kinematics_at(self, timestamp_ns: int) -> Kinematics:
        """Acceleration, angular rate and velocity at a time. Raises InputError as `pose_at`."""
        return self._window(self._message_at(timestamp_ns), timestamp_ns).kinematics_at(timestamp_ns)

    def _message_at(self, timestamp_ns: int) -> int:
        return int(np.searchsorted(self._times, timestamp_ns))

    def _end(self, indices: range, outermost: Callable[[list[int]], int]) -> int:
        """Time of the first sample of every link from one end of the bag on."""
        found: dict[str, int] = {}
        for index in indices[:MOST_MESSAGES]:
            for link, samples in self._read(index).items():
                found.setdefault(link, samples[0][0] if indices.step > 0 else samples[-1][0])
            if len(found) == len(self._links):
                return outermost(list(found.values()))
        raise InputError(f"{self._source}: has no poses of {' and '.join(self._links)}")

    def _read_window(self, message: int, timestamp_ns: int) -> EgoMotion:
        """The poses around a time."""
        grow = MESSAGES_AT_ONCE
        low, high = message - grow, message + grow
        while True:
            indices = range(max(low, 0), min(high, len(self._times)))
            samples = self._samples(indices)
            times = [time for time, _ in max(samples.values(), key=len)]
            has_all = all(samples.values())
            before = has_all and _reaches(times[::-1], timestamp_ns, -1)
            after = has_all and _reaches(times, timestamp_ns, 1)
            if (before or indices.start == 0) and (after or indices.stop == len(self._times)):
                break
            if len(indices) > MOST_MESSAGES:
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
        matrices = []
        for time in times:
            matrix = np.eye(4)
            for link in self._links:
                matrix = matrix @ _at(samples[link], time).matrix
            matrices.append(matrix if self._ego is None else matrix @ self._ego)
        if len(self._links) == 1 and self._ego is None:
            poses = [pose for _, pose in samples[self._links[0]]]  # with the sign of the quaternion as stated
        else:
            poses = [Pose.from_matrix(matrix) for matrix in matrices]
        stamps = np.array(times, dtype=np.int64)
        translations = np.stack([pose.translation for pose in poses])
        quaternions = np.stack([pose.quaternion for pose in poses])
        return EgoMotion(stamps, translations, quaternions, *_kinematics(stamps, translations, quaternions))


def _reaches(times: list[int], timestamp_ns: int, sign: int) -> bool:
    """Whether enough samples lie on one side of a time for derivatives there. times: the outermost last."""
    beyond = [time for time in times if sign * (time - timestamp_ns) >= 0]
    return len(beyond) > MARGIN and sign * (beyond[-1] - timestamp_ns) >= MARGIN * KINEMATICS_STEP_NS


def motion_from_poses(bag: Bag, topic: str, child_from_ego: Array | None) -> BagEgoMotion:
    """Poses of a topic with Odometry or poses. child_from_ego: (4, 4) from the frame of the poses, None: the same."""
    times = capture_times(bag, topic)

    def read(index: int) -> dict[str, list[Sample]]:
        try:
            found = pose_of(bag.message(topic, index))
        except (AttributeError, ValueError) as error:
            raise InputError(f"{bag.path}: {topic}: message {index} is not a pose ({error})") from None
        return {topic: [(found.timestamp_ns or int(times[index]), found.parent_from_child)]}

    return BagEgoMotion(times, read, (topic,), f"{bag.path}: {topic}", child_from_ego)


def motion_from_transforms(
    bag: Bag, topics: Sequence[str], frames: Sequence[str], child_from_ego: Array | None
) -> BagEgoMotion:
    """Poses along a chain of transforms. topics: with transforms that change.

    frames: the frame of the world first, each the parent of the next. child_from_ego: (4, 4) from the last of them to
    the ego vehicle, None if they are the same.
    """
    links = [f"{parent} to {child}" for parent, child in pairwise(frames)]
    by_child = dict(zip(frames[1:], links, strict=True))
    parts = [capture_times(bag, topic) for topic in topics]
    order = np.argsort(np.concatenate(parts), kind="stable")
    times = np.concatenate(parts)[order]
    places = [(topic, index) for topic, part in zip(topics, parts, strict=True) for index in range(len(part))]

    def read(index: int) -> dict[str, list[Sample]]:
        topic, message = places[order[index]]
        found: dict[str, list[Sample]] = {}
        for one in read_transforms(bag, topic, (message,)):
            if one.child in by_child:
                sample = (one.timestamp_ns or int(times[index]), one.parent_from_child)
                found.setdefault(by_child[one.child], []).append(sample)
        return found

    return BagEgoMotion(times, read, links, f"{bag.path}: {' and '.join(topics)}", child_from_ego)


def _at(samples: list[Sample], time: int) -> Pose:
    """The pose of one link at a time; outside of its samples, the nearest."""
    times = [stamp for stamp, _ in samples]
    later = bisect_left(times, time)
    if later == len(times):
        return samples[-1][1]
    if later == 0 or times[later] == time:
        return samples[later][1]
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
