"""The options `calibrate` of `bevcli run` and `motion` of `bevcli project-debug`."""

from bevcli.cli.progress import Progress
from bevcli.findings import Finding, errors_of
from bevcli.frame import Drive
from bevcli.printing import say
from bevcli.sequences.view import DriveView
from bevcli.workshop.calibration import CalibrateOptions, calibrate as calibration
from bevcli.workshop.calibration.estimates import Verdict, change_text
from bevcli.workshop.odometry.compare import STEPS, chosen_frames, stated_motion_steps, without_consequences


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
