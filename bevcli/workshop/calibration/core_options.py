"""The options `calibrate` of `bevcli run` and `motion` of `bevcli project-debug`."""

from bevcli.cli.progress import Progress
from bevcli.findings import Finding, errors_of
from bevcli.frame import Drive
from bevcli.printing import say
from bevcli.sequences.view import DriveView
from bevcli.workshop.calibration import CalibrateOptions, calibrate as calibration
from bevcli.workshop.calibration.estimates import Verdict, change_text
from bevcli.workshop.odometry.compare import stated_motion_findings, without_consequences


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
    motion = stated_motion_findings(drive)
    if errors_of(motion):  # which make a calibration wrong
        return motion
    return without_consequences(motion, calibration.motion_findings(drive), len(drive.rig.cameras))
