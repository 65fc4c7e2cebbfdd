"""The option `odometry` of `open_sequence`: a drive with the motion that its images show."""

from collections.abc import Callable

import numpy as np

from bevcli.errors import InputError
from bevcli.frame import Sequence
from bevcli.sequences.open import select, select_rate
from bevcli.workshop.odometry import measure
from bevcli.workshop.odometry.measure import MeasuredDrive, MeasuredMotion
from bevcli.workshop.odometry.report import check_measured, measured_note

MOST_RATE_HZ = 10.0  # a faster drive is measured at this rate: shorter steps cost time and add errors
FASTER = 1.5  # times this rate is thinned to it


def with_measured_motion(
    drive: Sequence, whole: Sequence, after_step: Callable[[int, int], None] | None = None
) -> MeasuredDrive:
    """The drive with its measured motion, which a note states.

    Args:
        drive: the frames that are used.
        whole: a drive with further frames: those between the first and the last one are measured too.
        after_step: called with the number of steps that are done, and of all.

    Raises InputError where the drive has several scenes, or not one step can be measured.
    """
    frames = at_most_rate(frames_between(drive, whole))
    motion = measured(frames, after_step)
    result = MeasuredDrive(drive, motion)
    result.notes = (*drive.notes, measured_note(motion))
    return result


def frames_between(drive: Sequence, whole: Sequence) -> Sequence:
    """The frames of `whole` from the first to the last frame of `drive`. Raises InputError for several scenes."""
    scenes = {stamp.scene for stamp in drive.stamps}
    if len(scenes) > 1:
        raise InputError(
            f"{drive.name}: has {len(scenes)} scenes (expected one, since its motion is measured from frame to frame): "
            "choose a `scene`"
        )
    first, last = drive.stamps[0], drive.stamps[-1]
    return select(
        whole,
        [
            place
            for place, stamp in enumerate(whole.stamps)
            if stamp.scene == first.scene and first.timestamp_ns <= stamp.timestamp_ns <= last.timestamp_ns
        ],
    )


def at_most_rate(drive: Sequence) -> Sequence:
    """The drive, thinned to MOST_RATE_HZ where its frames follow each other faster."""
    steps = np.diff([stamp.timestamp_ns for stamp in drive.stamps])
    if not len(steps) or np.median(steps) * FASTER * MOST_RATE_HZ > 1e9:
        return drive
    return select_rate(drive, MOST_RATE_HZ)


def measured(drive: Sequence, after_step: Callable[[int, int], None] | None = None) -> MeasuredMotion:
    """The motion of a drive. after_step: as in `with_measured_motion`. Raises InputError where no step is measured."""
    total, done = len(drive.stamps) - 1, 0

    def advance() -> None:
        nonlocal done
        done += 1
        if after_step is not None:
            after_step(done, total)

    if after_step is not None and total:
        after_step(0, total)
    motion = measure.measure_motion(drive, after_step=advance)
    check_measured(motion)
    return motion
