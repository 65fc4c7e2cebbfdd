"""The option `odometry` of `open_sequence`: a drive with the motion that its images show."""

from collections.abc import Iterator

import numpy as np

from bevcli.frame import Drive
from bevcli.geometry.ego_motion import EgoMotion
from bevcli.sequences.view import DriveView, select, select_rate
from bevcli.workshop.odometry.measure import MeasuredMotion, MeasuredStep, measure_steps
from bevcli.workshop.odometry.report import check_measured, measured_note

MOST_RATE_HZ = 10.0  # a faster drive is measured at this rate: shorter steps cost time and add errors
FASTER = 1.5  # times this rate is thinned to it


def with_measured_motion(drive: Drive, whole: Drive) -> Iterator[tuple[int, int] | DriveView]:
    """The number of steps that are measured and of all, scene by scene; at the end, the drive with that motion.

    A note of each scene states the motion.

    Args:
        drive: the frames that are used.
        whole: a drive with further frames: those between the first and the last one of a scene are measured too.

    Raises InputError where not one step of a scene can be measured.
    """
    motions, notes = dict[str, EgoMotion](), list[str]()
    for scene in dict.fromkeys(stamp.scene for stamp in drive.stamps):
        between = at_most_rate(frames_between(drive, whole, scene))
        steps, total = list[MeasuredStep](), len(between.stamps) - 1
        if total:
            yield 0, total
        for step in measure_steps(between):
            steps.append(step)
            yield len(steps), total
        motion = MeasuredMotion.of(between, steps)
        check_measured(motion)
        motions[scene] = motion.ego_motion
        notes.append(measured_note(motion))
    yield DriveView(drive, motions=motions, notes=tuple(notes))


def frames_between(drive: Drive, whole: Drive, scene: str) -> Drive:
    """The frames of `whole` from the first to the last frame of `drive` in a scene."""
    times = [stamp.timestamp_ns for stamp in drive.stamps if stamp.scene == scene]
    between = [stamp.scene == scene and times[0] <= stamp.timestamp_ns <= times[-1] for stamp in whole.stamps]
    return select(whole, np.flatnonzero(between).tolist())


def at_most_rate(drive: Drive) -> Drive:
    """The drive, thinned to MOST_RATE_HZ where its frames follow each other faster."""
    steps = np.diff([stamp.timestamp_ns for stamp in drive.stamps])
    if not len(steps) or np.median(steps) * FASTER * MOST_RATE_HZ > 1e9:
        return drive
    return select_rate(drive, MOST_RATE_HZ)
