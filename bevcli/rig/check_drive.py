"""`CheckedDrive` and `input_errors`: the cheap checks of a drive before a run."""

import numpy as np

from bevcli.findings import errors_of
from bevcli.frame import DerivedSequence, Sequence
from bevcli.rig.rig_report import rig_errors
from bevcli.rig.sequence_checks import check_scenes

CHECKED_POSES = 5000  # of a longer drive, every second, third, … pose is checked


class CheckedDrive(DerivedSequence):
    """A drive that was checked once. source: see `input_errors`.

    Attributes:
        input_errors: one line for each mistake.
    """

    def __init__(self, drive: Sequence, source: str = "SEQUENCE") -> None:
        super().__init__(drive)
        self.input_errors = input_errors(drive, source)


def input_errors(drive: Sequence, source: str = "SEQUENCE") -> tuple[str, ...]:
    """One line for each mistake in a drive's rig and ego-motion; none where they are plausible.

    These are the errors of `check_calibration` that need neither images nor the coverage of the BEV grid. source: the
    drive's path, for the command that each line names.
    """
    findings = rig_errors(drive.rig)
    motion = drive.ego_motion
    if motion is not None and drive.stamps:
        times, stamps = motion.timestamps_ns, drive.stamps
        during = np.flatnonzero((times >= stamps[0].timestamp_ns) & (times <= stamps[-1].timestamp_ns))
        checked = during[:: 1 + len(during) // CHECKED_POSES]
        findings += errors_of(check_scenes(motion.of_rows(checked), stamps))
    first = {(finding.code, finding.camera): finding for finding in reversed(findings)}  # scenes repeat a mistake
    return tuple(
        f"error in the input: {finding.line}; `bevcli project-debug {source}` says more"
        for finding in reversed(first.values())
    )
