"""A calibration of a drive without poses, in turn with its motion; the options of `run` and `project-debug`.

The motion in metres follows from the stated heights of the cameras. So their mean stays as it is stated: a rig that is
higher, on a vehicle that is faster, sees the same. So does a rig that is turned, on a vehicle that drives sideways.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from bevcli.cli.progress import Progress
from bevcli.errors import Finding, errors_of
from bevcli.frame import Drive
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.transforms import Array
from bevcli.printing import say
from bevcli.sequences.open import DriveView
from bevcli.workshop.calibration import CalibrateOptions, calibrate as calibration
from bevcli.workshop.calibration.calibrate import CalibrationResult, calibration_steps
from bevcli.workshop.calibration.estimates import Verdict, change_text
from bevcli.workshop.calibration.views import steps_reached
from bevcli.workshop.odometry.compare import STEPS, chosen_frames, stated_motion_steps, without_consequences
from bevcli.workshop.odometry.measure import MeasuredMotion, MeasuredStep, measure_steps
from bevcli.workshop.odometry.report import at_most_rate, check_measured

MOST_ROUNDS = 4
STILL_DEG, STILL_M = 0.02, 0.002  # changes of a camera from round to round, below which nothing moves any more
LEAST_STEP_M, FEWEST_STEPS = 0.5, 4  # steps that tell the direction in which the vehicle drives
MOTION_STEPS = 10  # of progress, in each round
ALL_STEPS = MOST_ROUNDS * (MOTION_STEPS + calibration.STEPS)


def calibrate_in_turn(drive: Drive, options: CalibrateOptions) -> Iterator[CalibrationResult | None]:
    """Measure the calibration of a drive and its motion, until both stand still. Its poses are not used.

    None after each part of the work but the last, then the result: at most ALL_STEPS parts, and fewer if fewer than
    MOST_ROUNDS rounds are needed.

    Raises InputError as `calibrate` does, and where the motion cannot be measured.
    """
    rig, rounds = drive.rig, 0
    while True:
        sampled = at_most_rate(DriveView(drive, rig=rig))
        steps, total = list[MeasuredStep](), max(len(sampled.stamps) - 1, 1)
        for step in measure_steps(sampled):
            steps.append(step)
            yield from steps_reached(MOTION_STEPS, len(steps), total)
        motion = MeasuredMotion.of(sampled, steps)
        check_measured(motion)
        moving = DriveView(drive, rig=drive.rig, motions={drive.stamps[0].scene: motion.ego_motion})
        for result in calibration_steps(moving, options):
            if result is None:
                yield None
        assert result is not None  # the last one
        rounds, before, rig = rounds + 1, rig, result.rig
        if rounds == MOST_ROUNDS or stands_still(before, rig):
            break
        yield None
    beside = beside_x_deg(np.stack([motion.ego_motion.pose_at(stamp.timestamp_ns).matrix for stamp in drive.stamps]))
    # Height and scale are those that were stated.
    height_m = float(np.mean([camera.ego_from_camera[2, 3] for camera in result.stated.cameras]))
    whole = replace(result.whole, scale=0.0, scale_deviation=options.position_m / height_m)
    whole = replace(whole, height_m=0.0, height_deviation_m=options.position_m)
    yield replace(result, name=drive.name, whole=whole, rounds=rounds, drives_beside_x_deg=beside)


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
    fitted, _, rank, _ = np.linalg.lstsq(columns, directions, rcond=None)
    scatter = float(np.sum((directions - columns @ fitted) ** 2)) / (len(steps) - rank)
    deviation = np.sqrt(scatter * np.linalg.pinv(columns.T @ columns)[0, 0])
    return float(np.degrees(fitted[0])), float(np.degrees(deviation))


def stands_still(before: CameraRig, after: CameraRig) -> bool:
    """True if no camera of a rig has changed by more than STILL_DEG and STILL_M."""
    for a, b in zip(before.cameras, after.cameras, strict=True):
        turn = a.ego_from_camera[:3, :3].T @ b.ego_from_camera[:3, :3]
        angle = np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))
        if angle > STILL_DEG or np.abs(a.ego_from_camera[:3, 3] - b.ego_from_camera[:3, 3]).max() > STILL_M:
            return False
    return True


def corrected(drive: Drive) -> Drive:
    """The drive with its measured calibration; the corrections are printed."""
    with Progress(calibration.STEPS, "steps of the calibration") as progress:
        result = calibration.last(progress.over(calibration.calibration_steps(drive, CalibrateOptions())))
    for camera in result.cameras:
        reason = change_text(camera) if camera.verdict is Verdict.CORRECTED else camera.reason
        say(f"calibration: {camera.camera} is {camera.verdict.value}" + (f": {reason}" if reason else ""), err=True)
    return DriveView(drive, rig=result.rig)


def check_motion(drive: Drive | None) -> tuple[Finding, ...]:
    """Findings about the poses of a drive, and of a short calibration with them; none of a calibration alone (None)."""
    if drive is None:
        return ()
    if _seems_sound(drive):
        say("poses and calibration fit the images: the long check of them is left out", err=True)
        return ()
    with Progress(STEPS + 1 + calibration.STEPS, "steps of the check of poses and calibration") as progress:
        motion = calibration.last(progress.over(stated_motion_steps(drive)))
        if errors_of(motion):  # which make a calibration wrong
            return motion
        progress.reach(STEPS + 1)
        measured = calibration.last(progress.over(calibration.motion_steps(drive)))
    return without_consequences(motion, measured, len(drive.rig.cameras))


def _seems_sound(drive: Drive) -> bool:
    """True where stated poses and calibration fit a few frames so well that the whole check has nothing to find."""
    if len({stamp.scene for stamp in drive.stamps}) != 1 or not drive.has_ego_motion:
        return False
    few = DriveView(drive, chosen_frames(drive))
    with Progress(calibration.SOUND_STEPS, "steps of the quick check of poses and calibration") as progress:
        return bool(calibration.last(progress.over(calibration.sound_steps(few))))
