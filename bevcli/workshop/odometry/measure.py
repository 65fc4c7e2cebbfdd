"""The measured motion of a drive, and the drive with it."""

from collections.abc import Sequence as Items
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bevcli.frame import DerivedSequence, Frame, Sequence
from bevcli.geometry.ego_motion import EgoMotion, motion_of_keyframes
from bevcli.geometry.transforms import Array, Pose
from bevcli.workshop.odometry.twist import exponential, logarithm

SUBSTEP_NS = 25_000_000  # between the poses of `MeasuredMotion.ego_motion`
BEYOND_NS = 100_000_000  # of constant velocity before the first and after the last frame, for cameras with other times


@dataclass(frozen=True)
class MeasuredStep:
    """The motion of the vehicle between two frames.

    Attributes:
        ego_a_from_ego_b: (4, 4) from the second frame to the first one; metres.
        covariance: (6, 6) of rotation (radians, in the ego frame of the first) and translation (metres).
        reason: why the step could not be measured: then it is a guess of constant velocity with a wide deviation; "" if
            it was measured.
        matches: number of matched points that were used.
        road_points: number of points of the road that were used.
    """

    ego_a_from_ego_b: Array
    covariance: Array
    reason: str = ""
    matches: int = 0
    road_points: int = 0

    @property
    def deviations(self) -> Array:
        """(6,) standard deviations of rotation (radians) and translation (metres)."""
        return np.sqrt(np.diag(self.covariance))


@dataclass(frozen=True)
class MeasuredMotion:
    """The motion of a drive of F frames.

    Attributes:
        name: of the drive.
        timestamps_ns: (F,) int64 of the frames, increasing.
        steps: F - 1, from each frame to the next one.
    """

    name: str
    timestamps_ns: NDArray[np.int64]
    steps: tuple[MeasuredStep, ...]

    @cached_property
    def poses(self) -> Array:
        """(F, 4, 4) world_from_ego; the first is the identity."""
        poses = [np.eye(4)]
        for step in self.steps:
            poses.append(poses[-1] @ step.ego_a_from_ego_b)
        return np.stack(poses)

    @cached_property
    def ego_motion(self) -> EgoMotion:
        """Poses and kinematics: those of the frames, and poses between them along each step's arc."""
        times, poses, steps = self.timestamps_ns, self.poses, [step.ego_a_from_ego_b for step in self.steps]
        between: list[tuple[int, Array]] = []
        for index, step in enumerate(steps):
            first = int(times[index])
            length = int(times[index + 1]) - first
            start = first - BEYOND_NS if index == 0 else first
            end = first + length + (BEYOND_NS if index == len(steps) - 1 else 0)
            twist = logarithm(step)
            between += [
                (time, poses[index] @ exponential((time - first) / length * twist))
                for time in range(start, end + 1, SUBSTEP_NS)
            ]
        return motion_of_keyframes(_table(list(zip(times.tolist(), poses, strict=True))), _table(between))


def _table(poses: Items[tuple[int, Array]]) -> tuple[NDArray[np.int64], Array, Array]:
    """Times, translations and quaternions of N poses, as `motion_of_keyframes` takes them."""
    matrices = [Pose.from_matrix(matrix) for _, matrix in poses]
    translations = np.array([pose.translation for pose in matrices]).reshape(-1, 3)
    quaternions = np.array([pose.quaternion for pose in matrices]).reshape(-1, 4)
    return np.array([time for time, _ in poses], dtype=np.int64), translations, quaternions


class MeasuredDrive(DerivedSequence):
    """A drive with its measured motion: poses and kinematics of every frame, and poses at each camera's own time."""

    def __init__(self, sequence: Sequence, motion: MeasuredMotion) -> None:
        super().__init__(sequence)
        self.motion, self.ego_motion, self.has_ego_motion = motion, motion.ego_motion, True

    def load(self, place: int) -> Frame:
        return self._moved(self.sequence.load(place))

    def ground_truth_frame(self, place: int) -> Frame:
        return self._moved(self.sequence.ground_truth_frame(place))

    def _moved(self, frame: Frame) -> Frame:
        motion, time = self.motion.ego_motion, frame.stamp.timestamp_ns
        times = {name: frame.images[name].timestamp_ns if name in frame.images else time for name in frame.rig.names}
        return replace(
            frame,
            world_from_ego=motion.pose_at(time),
            world_from_ego_at={name: motion.pose_at(at) for name, at in times.items()},
            kinematics=motion.kinematics_at(time),
        )
