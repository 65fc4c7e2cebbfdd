"""The option `calibrate` of `bevcli run`: measure the calibration of the drive first. Every run imports this file."""

from typing import TYPE_CHECKING

from bevcli.cli.bridge import Extension
from bevcli.options import option, options
from bevcli.printing import say

if TYPE_CHECKING:
    from bevcli.frame import Drive


@options("Input")
class CalibrateFirstOptions:
    """Whether a drive is calibrated before it is used."""

    calibrate: bool = option(
        default=False,
        help="Measure the calibration of the drive first, as `bevcli calibrate` does, and use the corrected one.",
    )


def _corrected(options: CalibrateFirstOptions, drive: "Drive") -> "Drive":
    """The drive with the rig that it shows, where this is asked for; what is corrected is printed."""
    if not options.calibrate:
        return drive
    from bevcli.cli.progress import Progress
    from bevcli.workshop.calibration import calibrate as calibration
    from bevcli.workshop.calibration.estimates import Verdict, change_text

    with Progress(calibration.STEPS, "steps of the calibration") as progress:
        result = calibration.calibrate(drive, after_step=progress.advance)
    for camera in result.cameras:
        reason = change_text(camera) if camera.verdict is Verdict.CORRECTED else camera.reason
        say(f"calibration: {camera.camera} is {camera.verdict.value}" + (f": {reason}" if reason else ""), err=True)
    return calibration.DriveWithRig(drive, result.rig)


CALIBRATE_FIRST = Extension(CalibrateFirstOptions, _corrected)
