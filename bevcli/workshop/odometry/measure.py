"""The measured motion of a drive, frame by frame, and that of a live rig without poses.

Of the motions that each step may have one is chosen by the votes of the road, and because speed and yaw rate are
smooth. A step is decided when the next one is measured: Viterbi's search with a delay of one step.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bevcli.errors import InputError
from bevcli.frame import Drive, Frame
from bevcli.geometry.ego_motion import GRAVITY, EgoMotion, Kinematics, derive_kinematics
from bevcli.geometry.transforms import Array, Pose
from bevcli.workshop.formats.poses import motion_of_keyframes
from bevcli.workshop.odometry import OdometryOptions
from bevcli.workshop.odometry.step_views import (
    CHANGE_RAD,
    COUNT,
    SLOPE_RAD,
    SLOPES,
    FrameView,
    StepViews,
    Viewer,
    exponential,
    logarithm,
    motion_of,
    next_slopes,
)
from bevcli.workshop.odometry.steps import NOT_TOLD, Candidate, Guess, SeenPoints, candidates, is_measured, reason_of

LEAPS = "its length contradicts the steps before and after, and few points of the road match"
SUBSTEP_NS = 25_000_000  # between the poses of `MeasuredMotion.ego_motion`
BEYOND_NS = 100_000_000  # of constant velocity before the first and after the last frame, for cameras with other times

# Deviations of a guess, for a second: of pitch and roll, of yaw (radians) and of the speed along the way (metres).
ROCKING, TURNING, SPEEDING = np.radians(3.0), np.radians(15.0), 4.0
LASTING = 0.75  # share of a slope that the next step expects: else an error of slopes would grow from step to step
UNKNOWN = 4.0  # factor of the deviations of a guess where nothing was measured before
UP = np.array([0.0, 0.0, 1.0])
# Measured steps that stated ones are compared with.
WIDEST = np.radians(2.0), 0.2, 0.3  # deviations of a step that counts as measured: yaw; length in its own, or metres
# Deviations of sound poses: roll, pitch and yaw of a step; its translation, and that in its length.
POSE_DEVIATIONS, LENGTH_DEVIATION = np.array([np.radians(1.0)] * 2 + [np.radians(0.1)] + [0.02, 0.02, 0.1]), 0.01
FREEDOMS = 6  # of a step


@dataclass(frozen=True)
class MeasuredStep:
    """The motion of the vehicle between two frames.

    A step that could not be measured is a guess of constant velocity with a wide deviation.
    """

    ego_a_from_ego_b: Array  # (4, 4) from the second frame to the first one; metres
    covariance: Array  # (6, 6) of rotation (radians, in the ego frame of the first) and translation (metres)
    reason: str = ""  # why the step could not be measured; "" if it was
    matches: int = 0  # number of matched points that were used
    road_points: int = 0  # number of points of the road that were used
    seen: SeenPoints | None = None  # some of both, for recordings; None where nothing was measured
    road: Array = field(default_factory=UP.copy)  # (3,) up from the road, ego frame of the second; longer if surer

    @property
    def road_normal(self) -> Array:
        """(3,) unit vector that points up from the road, ego frame of the second frame."""
        return self.road / np.linalg.norm(self.road)

    @property
    def deviations(self) -> Array:
        """(6,) standard deviations of rotation (radians) and translation (metres)."""
        return np.sqrt(np.diag(self.covariance))


@dataclass(frozen=True)
class MeasuredMotion:
    """The motion of a drive of F frames."""

    name: str  # of the drive
    timestamps_ns: NDArray[np.int64]  # (F,) of the frames, increasing
    steps: tuple[MeasuredStep, ...]  # F - 1, from each frame to the next one

    @classmethod
    def of(cls, drive: Drive, steps: Iterable[MeasuredStep]) -> "MeasuredMotion":
        """The motion of a drive with these steps."""
        times = np.array([stamp.timestamp_ns for stamp in drive.stamps], dtype=np.int64)
        return cls(drive.name, times, tuple(steps))

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
        motion = motion_of_keyframes(_table(list(zip(times.tolist(), poses, strict=True))), _table(between))
        columns = [np.interp(motion.timestamps_ns, times, column) for column in self.road_normals.T]
        return replace(motion, road_normals=np.stack(columns, axis=1) / np.linalg.norm(columns, axis=0)[:, None])

    @cached_property
    def road_normals(self) -> Array:
        """(F, 3) unit vectors that point up from the road, in the ego frame of each frame."""
        normals = [step.road_normal for step in self.steps]
        return np.stack([self.steps[0].ego_a_from_ego_b[:3, :3] @ normals[0], *normals])


def _table(poses: Sequence[tuple[int, Array]]) -> tuple[NDArray[np.int64], Array, Array]:
    """Times, translations and quaternions of N poses, as `motion_of_keyframes` takes them."""
    matrices = [Pose.from_matrix(matrix) for _, matrix in poses]
    translations = np.array([pose.translation for pose in matrices]).reshape(-1, 3)
    quaternions = np.array([pose.quaternion for pose in matrices]).reshape(-1, 4)
    return np.array([time for time, _ in poses], dtype=np.int64), translations, quaternions


VOTES = 6.0  # cost of a motion with 1/e of the votes
ACCELERATION, TURN = 2.0, np.radians(15.0)  # usual changes a second of speed (m/s) and of yaw rate (radians a second)
LEAP, LEAP_M = 2.0, 0.5  # m/s² and metres, of a way that differs from those of both neighbours alike
SURE = 60  # points of the road, of a motion that may leap all the same


def leaps(before: Candidate, candidate: Candidate, after: Candidate, seconds: tuple[float, float, float]) -> bool:
    """True for a motion with few points of the road whose speed is far above, or below, that of both neighbours."""
    steps = zip((before, candidate, after), seconds, strict=True)
    first, speed, last = (float(motion.speed_and_rate(time)[0]) for motion, time in steps)
    apart = min(abs(speed - first), abs(speed - last)) * seconds[1]
    alike = (speed - first) * (speed - last) > 0
    return candidate.road_points < SURE and alike and apart > LEAP_M + LEAP * seconds[1] ** 2


@dataclass
class Chain:
    """The undecided step, and what its motions cost so far."""

    _seconds: float = 0.0
    _candidates: Sequence[Candidate] = ()
    _costs: Array = field(default_factory=lambda: np.zeros(0))

    def add(self, candidates: Sequence[Candidate], seconds: float) -> Candidate | None:
        """Take the motions (one or more) of a step of some seconds; return that of the step before, if there is one."""
        most = max(candidate.votes for candidate in candidates)
        by_votes = np.array([VOTES * np.log(max(most, 1e-6) / max(motion.votes, 1e-6)) for motion in candidates])
        before, costs = self._candidates, by_votes
        decided = None
        if before:
            changes = np.array([[self._change(a, b, seconds) for b in candidates] for a in before])
            index = int(np.argmin(self._costs + (changes + by_votes).min(-1)))
            decided, costs = before[index], changes[index] + by_votes
        self._seconds, self._candidates, self._costs = seconds, candidates, costs
        return decided

    @property
    def likeliest(self) -> Candidate | None:
        """The motion of the undecided step that is the likeliest so far."""
        return self._candidates[int(np.argmin(self._costs))] if self._candidates else None

    def end(self) -> Candidate | None:
        """The motion of the last step; the chain starts anew."""
        decided = self.likeliest
        self._candidates, self._costs = (), np.zeros(0)
        return decided

    def _change(self, before: Candidate, after: Candidate, seconds: float) -> float:
        """The cost of a change of speed and yaw rate."""
        mean = (self._seconds + seconds) / 2
        slow, fast = before.speed_and_rate(self._seconds), after.speed_and_rate(seconds)
        changes = (fast - slow) / (mean * np.array([ACCELERATION, TURN]))
        return float(np.log1p(changes**2).sum())


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
        self._road = np.zeros(3)  # of the last step that is certain

    def add(self, frame: Frame) -> list[MeasuredStep]:
        """The steps that are certain now: of the frame before at the latest."""
        view, last = self._viewer.view(frame), self._last
        self._last = view
        if last is None:
            return []
        step = StepViews(last, view)
        seconds = step.seconds
        motions = candidates(step, Guess(self._expected(seconds), self._options.height_m))
        if not motions:
            before, self._guessed = self.finish(), self._guessed + 1
            return [*before, self._keep(self._guess(seconds, reason_of(step)))]
        decided = self._chain.add(motions, seconds)
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
                return self._keep(self._guess(self._seconds, LEAPS))
        self._guessed = 0 if is_measured(candidate) else self._guessed + 1
        return self._keep(self._step(candidate))

    def _keep(self, step: MeasuredStep) -> MeasuredStep:
        """A step that is certain."""
        self._road = step.road
        return step

    def _step(self, candidate: Candidate) -> MeasuredStep:
        """A motion as measured, or a guess where the images do not tell it."""
        if not is_measured(candidate):
            return self._guess(self._seconds, NOT_TOLD)
        of_points = candidate.matches, candidate.road_points, candidate.seen
        road = self._road_after(candidate.state, self._seconds, candidate.slopes_told)
        return MeasuredStep(motion_of(candidate.state), candidate.covariance, "", *of_points, road)

    def _road_after(self, state: Array, seconds: float, told: float = 0.0) -> Array:
        """`MeasuredStep.road` of a step: what the step tells of it, and the last one, carried along by its turn.

        The road changes with the way. Each second also tells a little that the vehicle stands on it without a tilt: so
        where the slope was never seen, it is that of the mean so far.
        """
        up = seconds / 2 * UP
        carried = motion_of(state)[:3, :3].T @ (self._road + up)
        way_m = min(float(np.hypot(*state[3:5])), 1.0)
        carried /= 1 + np.linalg.norm(carried) * way_m * (CHANGE_RAD / SLOPE_RAD) ** 2
        normal = np.array([*-next_slopes(state), 1.0])  # up from the road
        return np.asarray(carried + up + told * (normal / np.linalg.norm(normal)))

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
        state = np.zeros(COUNT - 1) if state is None else state
        return MeasuredStep(motion_of(state), np.diag(deviations**2), reason, road=self._road_after(state, seconds))


def measure_steps(drive: Drive, options: OdometryOptions | None = None) -> Iterator[MeasuredStep]:
    """Measure the motion of a drive of one scene: each step as soon as it is certain.

    Raises InputError where the drive has one frame, or several scenes.
    """
    scenes = {stamp.scene for stamp in drive.stamps}
    if len(scenes) > 1:
        raise InputError(f"{drive.name}: has {len(scenes)} scenes (expected one): choose a `scene` (`--scene`)")
    if len(drive.stamps) < 2:
        raise InputError(f"{drive.name}: has {len(drive.stamps)} frames (expected 2 or more): choose more frames")
    meter = MotionMeter(options)
    for index in range(len(drive.stamps)):
        yield from meter.add(drive.load(index))
    yield from meter.finish()


def measure_motion(drive: Drive, options: OdometryOptions | None = None) -> MeasuredMotion:
    """Measure the motion of a drive from its images and its calibration.

        motion = measure_motion(open_sequence("my_drive"))
        print(motion.poses)

    Poses that the drive states are not used. Steps that cannot be measured are guesses, and state the reason.

    Args:
        drive: of `open_sequence`, one scene.
        options: see `OdometryOptions`.

    Raises InputError where the drive has one frame, or several scenes.
    """
    return MeasuredMotion.of(drive, measure_steps(drive, options))


KEPT_POSES = 8  # of a live rig, from which the kinematics follow


class RecentPoses:
    """The newest poses of a vehicle, from which its motion is derived by differences to earlier times."""

    NEEDED = 3  # for an acceleration
    STEP_NS = 50_000_000  # poses closer than this in time are passed over: their differences are noise
    LONGEST_NS = 2_000_000_000  # older poses say nothing about the motion now

    def __init__(self, poses: tuple[tuple[int, Pose], ...] = ()) -> None:
        """poses: time in ns and world_from_ego, in order."""
        used = list(poses[-1:])
        for pose in reversed(poses):
            if len(used) < self.NEEDED and used[0][0] - pose[0] >= self.STEP_NS:
                used.insert(0, pose)
        self._used = used
        self._kept = poses if len(used) < self.NEEDED else tuple(pose for pose in poses if pose[0] >= used[0][0])

    def with_pose(self, timestamp_ns: int, pose: Pose) -> "RecentPoses":
        """The poses with a later one."""
        recent = (earlier for earlier in self._kept if timestamp_ns - earlier[0] <= self.LONGEST_NS)
        return RecentPoses((*recent, (timestamp_ns, pose)))

    def kinematics(self) -> Kinematics:
        """Acceleration, angular rate and velocity at the last pose."""
        times = np.array([time for time, _ in self._used], dtype=np.int64)
        translations = np.stack([pose.translation for _, pose in self._used])
        quaternions = np.stack([pose.quaternion for _, pose in self._used])
        accelerations, rates, velocities = derive_kinematics(times, translations, quaternions)
        if len(times) < self.NEEDED:
            return Kinematics(accelerations[-1], rates[-1], velocities[-1])
        seconds = np.diff(times) / 1e9
        before, now = np.diff(translations, axis=0) / seconds[:, None]  # world frame, in the middle of each step
        acceleration = (now - before) / seconds.mean() + (0, 0, GRAVITY)
        return Kinematics(self._used[-1][1].matrix[:3, :3].T @ acceleration, rates[-1], velocities[-1])


class LiveMotion:
    """Measures the motion to each frame at once, and once more when the next frame is there.

    The world frame is the ego frame of the first frame.

    Attributes:
        step: the newest step, to the newest frame; None for the first frame.
        kinematics: at the newest frame, from the best known poses.
    """

    def __init__(self, meter: MotionMeter | None = None) -> None:
        """meter: measures the steps. Default: a new one."""
        self._meter = MotionMeter() if meter is None else meter
        self._path: list[tuple[int, Pose]] = []
        self._open = 0  # steps at the end of the path that are not certain
        self.step: MeasuredStep | None = None
        self.kinematics: Kinematics | None = None

    def add(self, frame: Frame) -> tuple[Pose | None, Pose]:
        """world_from_ego of the frame before as it is known now, None for the first frame; and of this frame."""
        steps = self._meter.add(frame)
        self._path.append((frame.stamp.timestamp_ns, Pose.identity()))
        if len(self._path) > 1:
            self._open += 1
            certain, newest = len(steps), self._meter.newest
            if certain < self._open and newest is not None:
                steps = [*steps, newest]
            for index, step in zip(range(-self._open, 0), steps, strict=True):
                before = self._path[index - 1][1].matrix
                self._path[index] = self._path[index][0], Pose.from_matrix(before @ step.ego_a_from_ego_b)
            self._open -= certain
            self.step = steps[-1]
        self._path = self._path[-KEPT_POSES:]
        self.kinematics = RecentPoses(tuple(self._path)).kinematics()
        return (self._path[-2][1] if len(self._path) > 1 else None), self._path[-1][1]


@dataclass(frozen=True)
class MeasuredSteps:
    """K measured steps, and how far other steps are from them in standard deviations."""

    times_ns: NDArray[np.int64]  # (K + 1,) of the frames
    poses: Array  # (K + 1, 4, 4) world_from_ego
    steps: Array  # (K, 4, 4)
    precisions: Array  # (K, 6, 6) of the difference to a sound stated step
    is_used: NDArray[np.bool_]  # (K,) measured well, and covered by the stated poses

    @classmethod
    def of(cls, motion: MeasuredMotion) -> "MeasuredSteps":
        """The steps of a measured motion; those without a reason and with small deviations are used."""
        steps = np.stack([step.ego_a_from_ego_b for step in motion.steps])
        covariances = np.stack([step.covariance for step in motion.steps])
        lengths = np.linalg.norm(steps[:, :3, 3], axis=1)
        deviations = np.broadcast_to(POSE_DEVIATIONS, (len(steps), 6)).copy()
        deviations[:, 3:5] = np.hypot(deviations[:, 3:5], LENGTH_DEVIATION * lengths[:, None])
        yaw, share, metres = WIDEST
        spread = np.sqrt(covariances[:, 3, 3] + covariances[:, 4, 4])
        is_used = (np.sqrt(covariances[:, 2, 2]) < yaw) & (spread < np.maximum(share * lengths, metres))
        is_used &= [not step.reason for step in motion.steps]
        precisions = np.linalg.inv(covariances + np.einsum("ki,ij->kij", deviations**2, np.eye(6)))
        return cls(motion.timestamps_ns, motion.poses, steps, precisions, is_used)

    def differences(self, steps: Array) -> Array:
        """(..., K, 6) rotation and translation of steps (..., K, 4, 4) minus the measured ones."""
        turns = steps[..., :3, :3] @ np.swapaxes(self.steps[:, :3, :3], 1, 2)
        vectors = Rotation.from_matrix(turns.reshape(-1, 3, 3)).as_rotvec().reshape(*steps.shape[:-2], 3)
        return np.concatenate([vectors, steps[..., :3, 3] - self.steps[:, :3, 3]], axis=-1)

    def distances(self, steps: Array) -> Array:
        """(..., K) the length of the differences in standard deviations."""
        return np.sqrt(self.squared(self.differences(steps)))

    def squared(self, differences: Array) -> Array:
        """(..., K) squared distances of differences (..., K, 6)."""
        return np.einsum("...ki,kij,...kj->...k", differences, self.precisions, differences)

    def cost(self, distances: Array, is_used: NDArray[np.bool_] | None = None) -> Array:
        """(...) robust cost of distances (..., K): that of the steps in use, times the number of all that are used."""
        used = self.is_used if is_used is None else self.is_used & is_used
        of_used = np.where(used, FREEDOMS * np.log1p(distances**2 / FREEDOMS), 0).sum(-1)
        return of_used * self.is_used.sum() / np.maximum(used.sum(-1), 1)

    def weights(self, squared: Array) -> Array:
        """(..., K) robust weights of squared distances."""
        return self.is_used / (1 + squared / FREEDOMS)
