"""CorrectedDrive: a drive with the rig that `calibrate` has measured."""

from dataclasses import replace

from bevcli.calibration.result import CalibrationResult
from bevcli.frame import DerivedSequence, Frame, Sequence


class CorrectedDrive(DerivedSequence):
    """The drive of a calibration, with its corrected rig in every frame."""

    def __init__(self, sequence: Sequence, result: CalibrationResult) -> None:
        super().__init__(sequence)
        self.rig = result.rig

    def load(self, place: int) -> Frame:
        """The frame at a place, with the corrected rig."""
        return replace(self.sequence.load(place), rig=self.rig)
