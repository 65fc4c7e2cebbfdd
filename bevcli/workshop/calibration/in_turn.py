"""A calibration of a drive without poses: its motion and its calibration are measured in turn.

The motion in metres follows from the stated heights of the cameras. So their mean stays as it is stated: a rig that is
higher, on a vehicle that is faster, sees the same.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from bevcli.frame import Sequence
from bevcli.geometry.cameras import CameraRig
from bevcli.options import gather
from bevcli.workshop.calibration import CalibrateOptions
from bevcli.workshop.calibration.calibrate import CalibrationResult, DriveWithRig, RigEstimate, calibrate

MOST_ROUNDS = 4
STILL_DEG, STILL_M = 0.02, 0.002  # changes of a camera from round to round, below which nothing moves any more


def calibrate_in_turn(
    drive: Sequence,
    with_motion: Callable[[Sequence], Sequence],
    options: CalibrateOptions | None = None,
    *,
    after_step: Callable[[], None] = lambda: None,
    **changes: Any,
) -> CalibrationResult:
    """Measure the calibration of a drive and its motion, until both stand still.

    Args:
        drive: as in `calibrate`, but its poses are not used.
        with_motion: the drive with the motion that its images show, for its rig.
        options, changes: see `CalibrateOptions`.
        after_step: called STEPS times in each of at most MOST_ROUNDS rounds.

    Raises InputError as `calibrate` does.
    """
    chosen, rig = gather(CalibrateOptions, options, changes), drive.rig
    rounds, still = 0, False
    while rounds < MOST_ROUNDS and not still:
        moving = DriveWithRig(with_motion(DriveWithRig(drive, rig)), drive.rig)
        result = calibrate(moving, chosen, after_step=after_step)
        rounds, still, rig = rounds + 1, stands_still(rig, result.rig), result.rig
    return replace(result, name=drive.name, whole=_without_scale(result, chosen), rounds=rounds)


def stands_still(before: CameraRig, after: CameraRig) -> bool:
    """True if no camera of a rig has changed by more than STILL_DEG and STILL_M."""
    for a, b in zip(before.cameras, after.cameras, strict=True):
        turn = a.ego_from_camera[:3, :3].T @ b.ego_from_camera[:3, :3]
        angle = np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))
        if angle > STILL_DEG or np.abs(a.ego_from_camera[:3, 3] - b.ego_from_camera[:3, 3]).max() > STILL_M:
            return False
    return True


def _without_scale(result: CalibrationResult, options: CalibrateOptions) -> RigEstimate:
    """What is said about the whole rig, where height and scale are those that were stated."""
    height = float(np.mean([camera.ego_from_camera[2, 3] for camera in result.stated.cameras]))
    return replace(
        result.whole,
        scale=0.0,
        scale_deviation=options.position_m / height,
        height_m=0.0,
        height_deviation_m=options.position_m,
    )
