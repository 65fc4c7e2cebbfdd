"""The check of `bevcli project-debug`: the stated poses of a drive against some measured steps of it."""

from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.findings import Finding
from bevcli.frame import Drive, Frame
from bevcli.geometry.ego_motion import EgoMotion, derive_kinematics
from bevcli.geometry.transforms import Array, Pose
from bevcli.sequences.open import Selection
from bevcli.workshop.odometry.compare import compare, not_compared
from bevcli.workshop.odometry.measure import measure_motion
from bevcli.workshop.odometry.stated import Poses, steps_between

STEPS = 8  # that are measured
LEAST_NS = 400_000_000  # between two frames
MOST_TURN, MOVES_M, MOVING = 0.3, 0.5, 0.05  # what a step tells: its turn up to this, radians; and that it moves


class SomeFrames(Selection):
    """Some frames of a drive. It keeps the poses of those that were loaded, by their times."""

    def __init__(self, drive: Drive, places: list[int]) -> None:
        super().__init__(drive, places)
        self.poses: dict[int, Pose] = {}

    def load(self, index: int) -> Frame:
        frame = super().load(index)
        self.poses[frame.stamp.timestamp_ns] = frame.world_from_ego
        return frame

    @property
    def stated(self) -> EgoMotion:
        """The poses of the drive: in its table, or of the frames that were loaded."""
        if self.ego_motion is not None:
            return self.ego_motion
        times, poses = np.array(sorted(self.poses), dtype=np.int64), [self.poses[time] for time in sorted(self.poses)]
        rows = times, np.stack([pose.translation for pose in poses]), np.stack([pose.quaternion for pose in poses])
        return EgoMotion(*rows, *derive_kinematics(*rows), velocities_are_stated=False)


def stated_motion_findings(drive: Drive, steps: int = STEPS) -> tuple[Finding, ...]:
    """Findings about the stated poses of a drive, from a few measured steps; none for a drive without poses."""
    if not drive.has_ego_motion:
        return ()
    part = SomeFrames(drive, chosen_places(drive, steps))
    try:
        measured = measure_motion(part)
    except InputError as error:
        return (not_compared(str(error)),)
    return compare(part.stated, measured, [stamp.index for stamp in part.stamps])


def chosen_places(drive: Drive, steps: int = STEPS) -> list[int]:
    """The places of at most steps + 1 frames of the longest scene, those between which the poses turn most."""
    scenes = [list(places) for _, places in groupby(range(len(drive.stamps)), lambda place: drive.stamps[place].scene)]
    places: list[int] = []
    for place in max(scenes, key=len, default=[]):
        if not places or drive.stamps[place].timestamp_ns - drive.stamps[places[-1]].timestamp_ns >= LEAST_NS:
            places.append(place)
    starts = len(places) - steps
    if starts <= 1:
        return places
    worth = np.zeros(len(places) - 1)
    if drive.ego_motion is not None:
        worth = _worth(drive.ego_motion, np.array([drive.stamps[place].timestamp_ns for place in places]))
    sums = np.convolve(worth, np.ones(steps), mode="valid")
    start = int(sums.argmax()) if np.ptp(sums) > 0 else starts // 2
    return places[start : start + steps + 1]


def _worth(motion: EgoMotion, times_ns: NDArray[np.int64]) -> Array:
    """(F - 1,) what the steps between frames tell of mistakes."""
    steps = steps_between(Poses.of(motion).at(times_ns)[0])
    turns = np.abs(np.arctan2(steps[:, 1, 0], steps[:, 0, 0]))
    return np.minimum(turns, MOST_TURN) + MOVING * (np.linalg.norm(steps[:, :3, 3], axis=1) > MOVES_M)


def without_consequences(
    motion: tuple[Finding, ...], calibration: tuple[Finding, ...], cameras: int
) -> tuple[Finding, ...]:
    """The findings about poses, none of them an error, and about the calibration measured with them: one cause each.

    A small difference, such as a scale, may come from single cameras that are off: it is taken for that where fewer
    than half of the cameras are. If nothing could be measured, the calibration says why.
    """
    off = [finding for finding in calibration if finding.code == "calibration-off"]
    if any(finding.severity == "warning" for finding in motion):
        return calibration if 0 < len(off) < cameras / 2 else motion
    is_measured = any(finding.severity != "info" for finding in calibration) or not calibration
    return (*motion, *calibration) if is_measured else calibration
