"""What a calibration from motion finds, as findings for `bevcli project-debug`."""

from collections.abc import Iterable

from bevcli.calibration.calibrate import calibrate
from bevcli.calibration.estimates import CameraEstimate, Verdict
from bevcli.calibration.table import change_text, delay_text, either_text
from bevcli.errors import InputError
from bevcli.findings import Finding
from bevcli.frame import Sequence

SHORT_PAIRS = 8  # of frames


def motion_findings(drive: Sequence) -> tuple[Finding, ...]:
    """Findings about the cameras whose calibration does not fit how the vehicle moves, measured from a few frames."""
    try:
        result = calibrate(drive, pairs=SHORT_PAIRS)
    except InputError as error:
        return (Finding("motion-not-measured", "info", None, f"the drive does not show its calibration: {error}"),)
    return findings_of(result.cameras)


def findings_of(cameras: Iterable[CameraEstimate]) -> tuple[Finding, ...]:
    """A finding for each camera that is corrected, and for each whose capture times are off."""
    found = []
    for each in cameras:
        if each.verdict is Verdict.CORRECTED:
            found.append(_off(each))
        if delay_text(each):
            found.append(_late(each))
        if either_text(each):
            advice = "choose a part of the drive that turns and drives straight on"
            found.append(Finding("capture-times-off", "warning", each.camera, either_text(each), "", "", advice))
    return tuple(found)


def _off(estimate: CameraEstimate) -> Finding:
    message, advice = (
        "does not fit how the vehicle moves",
        "measure it with `bevcli calibrate`",
    )
    return Finding("calibration-off", "warning", estimate.camera, message, change_text(estimate), "", advice)


def _late(estimate: CameraEstimate) -> Finding:
    found = f"{estimate.delay_ms:+.0f} ms ± {estimate.delay_deviation_ms:.0f} ms"
    message, advice = "its images were taken at another time than stated", "correct its timestamps"
    return Finding("capture-times-off", "warning", estimate.camera, message, found, "0 ms", advice)
