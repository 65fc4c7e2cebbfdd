"""A calibration of a drive without poses: its motion and its calibration are measured in turn.

The motion in metres follows from the stated heights of the cameras. So their mean stays as it is stated: a rig that is
higher, on a vehicle that is faster, sees the same. So does a rig that is turned, on a vehicle that drives sideways.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from bevcli.frame import Drive
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.transforms import Array
from bevcli.options import gather
from bevcli.sequences.view import DriveView
from bevcli.workshop.calibration import CalibrateOptions
from bevcli.workshop.calibration.calibrate import STEPS, CalibrationResult, calibrate
from bevcli.workshop.calibration.estimates import RigEstimate
from bevcli.workshop.odometry.drives import with_measured_motion

MOST_ROUNDS = 4
STILL_DEG, STILL_M = 0.02, 0.002  # changes of a camera from round to round, below which nothing moves any more
LEAST_STEP_M, FEWEST_STEPS = 0.5, 4  # steps that tell the direction in which the vehicle drives
MOTION_STEPS = 10  # of progress, in each round
ALL_STEPS = MOST_ROUNDS * (MOTION_STEPS + STEPS)
AfterStep = Callable[[int, int], None]  # steps that are done, and of how many


def calibrate_in_turn(
    drive: Drive,
    options: CalibrateOptions | None = None,
    *,
    with_motion: Callable[[Drive, AfterStep], Drive] | None = None,
    after_step: Callable[[], None] = lambda: None,
    **changes: Any,
) -> CalibrationResult:
    """Measure the calibration of a drive and its motion, until both stand still.

    Args:
        drive: as in `calibrate`, but its poses are not used.
        options, changes: see `CalibrateOptions`.
        with_motion: the drive with the motion that its images show for its rig. Default: that of `bevcli odometry`.
        after_step: called at most ALL_STEPS times; less often if fewer than MOST_ROUNDS rounds are needed.

    Raises InputError as `calibrate` does, and where the motion cannot be measured.
    """
    chosen, rig = gather(CalibrateOptions, options, changes), drive.rig
    measured = with_motion or (lambda drive, after_step: with_measured_motion(drive, drive, after_step))
    rounds, still = 0, False
    while rounds < MOST_ROUNDS and not still:
        moving = measured(DriveView(drive, rig=rig), _in_parts(after_step))
        result = calibrate(DriveView(moving, rig=drive.rig), chosen, after_step=after_step)
        rounds, still, rig = rounds + 1, stands_still(rig, result.rig), result.rig
    whole, motion, places = _without_scale(result, chosen), moving.ego_motion, range(len(moving.stamps))
    poses = [
        moving.load(k).world_from_ego if motion is None else motion.pose_at(moving.stamps[k].timestamp_ns)
        for k in places
    ]
    beside = beside_x_deg(np.stack([pose.matrix for pose in poses]))
    return replace(result, name=drive.name, whole=whole, rounds=rounds, drives_beside_x_deg=beside)


def beside_x_deg(poses: Array) -> tuple[float, float]:
    """The direction in which a vehicle drives, to the left of x of its ego frame, and its deviation; degrees.

    poses: (F, 4, 4) world_from_ego. In a turn the direction depends on where the ego frame is, so it is that without.
    """
    steps = np.linalg.inv(poses[:-1]) @ poses[1:]
    steps = steps[np.hypot(steps[:, 0, 3], steps[:, 1, 3]) > LEAST_STEP_M]
    if len(steps) < FEWEST_STEPS:
        return 0.0, 180.0
    turns = np.arctan2(steps[:, 1, 0], steps[:, 0, 0])
    directions = np.arctan2(steps[:, 1, 3], steps[:, 0, 3])
    columns = np.stack([np.ones(len(steps)), turns], axis=-1)
    found, _, rank, _ = np.linalg.lstsq(columns, directions, rcond=None)
    scatter = float(np.sum((directions - columns @ found) ** 2)) / (len(steps) - rank)
    deviation = np.sqrt(scatter * np.linalg.pinv(columns.T @ columns)[0, 0])
    return float(np.degrees(found[0])), float(np.degrees(deviation))


def _in_parts(after_step: Callable[[], None]) -> AfterStep:
    """Calls `after_step` MOTION_STEPS times while a motion is measured."""
    reached = 0

    def advance(done: int, total: int) -> None:
        nonlocal reached
        for _ in range(MOTION_STEPS * done // max(total, 1) - reached):
            after_step()
            reached += 1

    return advance


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
