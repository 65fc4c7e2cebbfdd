"""The measured motion of a drive, and the drive with it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.frame import DerivedDrive, Drive, Frame
from bevcli.geometry.ego_motion import EgoMotion, motion_of_keyframes
from bevcli.geometry.transforms import Array, Pose, inverse
from bevcli.workshop.odometry import OdometryOptions
from bevcli.workshop.odometry.chain import Chain, leaps
from bevcli.workshop.odometry.frames import FrameView, Viewer
from bevcli.workshop.odometry.seen_points import SeenPoints
from bevcli.workshop.odometry.steps import NOT_TOLD, Candidate, Guess, StepViews, candidates, is_measured, reason_of
from bevcli.workshop.odometry.unknowns import SLOPES, exponential, logarithm, motion_of, next_slopes

LEAPS = "its length contradicts the steps before and after, and few points of the road match"
SUBSTEP_NS = 25_000_000  # between the poses of `MeasuredMotion.ego_motion`
BEYOND_NS = 100_000_000  # of constant velocity before the first and after the last frame, for cameras with other times

# Deviations of a guess, for a second: of pitch and roll, of yaw (radians) and of the speed along the way (metres).
ROCKING, TURNING, SPEEDING = np.radians(3.0), np.radians(15.0), 4.0
LASTING = 0.75  # share of a slope that the next step expects: else an error of slopes would grow from step to step
UNKNOWN = 4.0  # factor of the deviations of a guess where nothing was measured before


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
        seen: some of both, for recordings; None where nothing was measured.
    """

    ego_a_from_ego_b: Array
    covariance: Array
    reason: str = ""
    matches: int = 0
    road_points: int = 0
    seen: SeenPoints | None = None

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


class MotionMeter:
    """Measures the motion frame by frame. It keeps the views of the last frame, and one step that is not decided."""

    def __init__(self, options: OdometryOptions | None = None) -> None:
        """options: see `OdometryOptions`."""
        self._options = options or OdometryOptions()
        self._viewer, self._chain = Viewer(), Chain()
        self._last: FrameView | None = None
        self._before: tuple[Array, float] | None = None  # the state of the step before and its seconds
        self._seconds, self._guessed = 0.0, 0  # of the step that is not decided; guesses in a row
        self._sure: tuple[Candidate, float] | None = None  # the measured step before that one, and its seconds

    def add(self, frame: Frame) -> list[MeasuredStep]:
        """The steps that are certain now: of the frame before at the latest."""
        view, last = self._viewer.view(frame), self._last
        self._last = view
        if last is None:
            return []
        seconds = (view.timestamp_ns - last.timestamp_ns) / 1e9
        step = StepViews(last, view)
        found = candidates(step, Guess(self._expected(seconds), self._options.height_m))
        if not found:
            before, self._guessed = self.finish(), self._guessed + 1
            return [*before, self._guess(seconds, reason_of(step))]
        decided = self._chain.add(found, seconds)
        likeliest = self._chain.likeliest
        assert likeliest is not None
        steps = [] if decided is None else [self._decided(decided, (likeliest, seconds))]
        self._seconds = seconds
        if is_measured(likeliest):
            self._before = likeliest.state, seconds
        return steps

    @property
    def newest(self) -> MeasuredStep | None:
        """The step that is not decided, with the motion that is the likeliest so far; None where all are."""
        likeliest = self._chain.likeliest
        return None if likeliest is None else self._step(likeliest)

    def finish(self) -> list[MeasuredStep]:
        """The step that is not decided, if there is one. Called after the last frame."""
        decided = self._chain.end()
        return [] if decided is None else [self._decided(decided)]

    def _decided(self, candidate: Candidate, after: tuple[Candidate, float] | None = None) -> MeasuredStep:
        """A step, whose neighbours may contradict it. after: the motion of the next one and its seconds."""
        before, self._sure = self._sure, (candidate, self._seconds) if is_measured(candidate) else None
        if before and after and is_measured(candidate) and is_measured(after[0]):
            lasted = before[1], self._seconds, after[1]
            if leaps(before[0], candidate, after[0], lasted):
                self._before, self._sure = (before[0].state, before[1]), None
                self._guessed += 1
                return self._guess(self._seconds, LEAPS)
        self._guessed = 0 if is_measured(candidate) else self._guessed + 1
        return self._step(candidate)

    def _step(self, candidate: Candidate) -> MeasuredStep:
        """A motion as measured, or a guess where the images do not tell it."""
        if not is_measured(candidate):
            return self._guess(self._seconds, NOT_TOLD)
        return MeasuredStep(
            motion_of(candidate.state),
            candidate.covariance,
            matches=candidate.matches,
            road_points=candidate.road_points,
            seen=candidate.seen,
        )

    def _expected(self, seconds: float) -> Array | None:
        """(8,) the state of a step at constant velocity."""
        if self._before is None:
            return None
        state, lasted = self._before
        expected = state * seconds / lasted
        expected[SLOPES], expected[5] = LASTING * next_slopes(state), 0
        return expected

    def _guess(self, seconds: float, reason: str) -> MeasuredStep:
        state = self._expected(seconds)
        wide = seconds * np.sqrt(max(1, self._guessed)) if state is not None else seconds * UNKNOWN
        deviations = wide * np.array([*[ROCKING] * 2, TURNING, SPEEDING, SPEEDING / 4, SPEEDING / 8])
        motion = np.eye(4) if state is None else motion_of(state)
        return MeasuredStep(motion, np.diag(deviations**2), reason)


def measure_motion(
    drive: Drive, options: OdometryOptions | None = None, after_step: Callable[[], None] = lambda: None
) -> MeasuredMotion:
    """Measure the motion of a drive from its images and its calibration.

        motion = measure_motion(open_sequence("my_drive"))
        print(motion.poses)

    Poses that the drive states are not used. Steps that cannot be measured are guesses, and state the reason.

    Args:
        drive: of `open_sequence`, one scene.
        options: see `OdometryOptions`.
        after_step: called after each frame but the first.

    Raises InputError where the drive has one frame, or several scenes.
    """
    scenes = {stamp.scene for stamp in drive.stamps}
    if len(scenes) > 1:
        raise InputError(f"{drive.name}: has {len(scenes)} scenes (expected one): choose a `scene`")
    if len(drive.stamps) < 2:
        raise InputError(f"{drive.name}: has {len(drive.stamps)} frames (expected 2 or more): choose more frames")
    meter, steps = MotionMeter(options), list[MeasuredStep]()
    for place in range(len(drive.stamps)):
        steps += meter.add(drive.load(place))
        if place:
            after_step()
    steps += meter.finish()
    times = np.array([stamp.timestamp_ns for stamp in drive.stamps], dtype=np.int64)
    return MeasuredMotion(drive.name, times, tuple(steps))


def _table(poses: Sequence[tuple[int, Array]]) -> tuple[NDArray[np.int64], Array, Array]:
    """Times, translations and quaternions of N poses, as `motion_of_keyframes` takes them."""
    matrices = [Pose.from_matrix(matrix) for _, matrix in poses]
    translations = np.array([pose.translation for pose in matrices]).reshape(-1, 3)
    quaternions = np.array([pose.quaternion for pose in matrices]).reshape(-1, 4)
    return np.array([time for time, _ in poses], dtype=np.int64), translations, quaternions


class MeasuredDrive(DerivedDrive):
    """A drive with its measured motion: poses and kinematics of every frame, and poses at each camera's own time.

    Ground truth in the world frame is moved with the vehicle.
    """

    def __init__(self, sequence: Drive, motion: MeasuredMotion) -> None:
        super().__init__(sequence)
        self.motion, self.ego_motion, self.has_ego_motion = motion, motion.ego_motion, True
        self.facts = replace(sequence.facts, geo_origin=None, motion_measured=True)

    def load(self, index: int) -> Frame:
        return self._moved(self.sequence.load(index))

    def ground_truth_frame(self, index: int) -> Frame:
        return self._moved(self.sequence.ground_truth_frame(index))

    def _moved(self, frame: Frame) -> Frame:
        motion, time = self.motion.ego_motion, frame.stamp.timestamp_ns
        times = {name: frame.images[name].timestamp_ns if name in frame.images else time for name in frame.rig.names}
        pose, truth = motion.pose_at(time), frame.ground_truth
        moved = pose.matrix @ inverse(frame.world_from_ego.matrix)
        return replace(
            frame,
            world_from_ego=pose,
            ground_truth=None if truth is None else truth.transformed(moved),
            world_from_ego_at={name: motion.pose_at(at) for name, at in times.items()},
            kinematics=motion.kinematics_at(time),
            sample_token=None,  # of a submission, whose boxes are in the world of nuScenes
        )
