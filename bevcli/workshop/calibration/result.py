"""CalibrationResult: the estimates, the corrected rig, the drive with it, and the files."""

import json
from collections.abc import Sequence as Items
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from bevcli.frame import DerivedSequence, DriveFacts, Frame, Sequence
from bevcli.geometry.cameras import CameraRig
from bevcli.sequences.files.calibration_file import write_calibration
from bevcli.workshop.calibration.estimates import CameraEstimate, RigEstimate, Verdict, rig_text, table
from bevcli.workshop.calibration.measure import Measurement
from bevcli.workshop.calibration.unknowns import moved
from bevcli.writing import write_whole


@dataclass(frozen=True)
class CalibrationResult:
    """The result of `calibrate`.

    Attributes:
        name: of the drive.
        stated: the rig of the drive.
        rig: the corrected rig; cameras that are fine or not measurable are as stated.
        cameras: the estimates, in the rig's order.
        whole: what is said about the whole rig.
        pairs: number of frame pairs that were used.
        facts: of the drive, for calibration.json.
        measurement: what it was measured from.
    """

    name: str
    stated: CameraRig
    rig: CameraRig
    cameras: tuple[CameraEstimate, ...]
    whole: RigEstimate
    pairs: int
    facts: DriveFacts
    measurement: Measurement

    def __getitem__(self, camera: str) -> CameraEstimate:
        return next(each for each in self.cameras if each.camera == camera)

    @property
    def corrected(self) -> tuple[CameraEstimate, ...]:
        """The cameras whose calibration is corrected."""
        return tuple(each for each in self.cameras if each.verdict is Verdict.CORRECTED)

    def text(self) -> str:
        """One row a camera, and lines about the whole rig, for a terminal."""
        pairs = f"{self.name}: {self.pairs} frame pairs; off by: stated minus measured, ± standard deviation"
        return "\n".join([table(self.cameras), "", pairs, rig_text(self.whole, self.cameras)])

    def to_json(self) -> str:
        """The content of report.json."""
        content = {
            "drive": self.name,
            "pairs": self.pairs,
            "cameras": {each.camera: each.to_dict() for each in self.cameras},
            "rig": asdict(self.whole),
        }
        return json.dumps(content, indent=1, ensure_ascii=False)

    def write(self, folder: Path | str) -> list[Path]:
        """Write calibration.json (the corrected rig), report.json, calibration.png and recording.rrd into a folder.

        Returns their paths. The folder is made where it is missing; existing files are overwritten. Raises OutputError.
        """
        # Only writing draws: matplotlib and rerun take a second to load.
        from bevcli.workshop.calibration.drawings import write_calibration_recording, write_sheet

        folder = Path(folder)
        paths = [folder / name for name in ("calibration.json", "report.json", "calibration.png", "recording.rrd")]
        write_whole(paths[1], f"{self.to_json()}\n".encode(), parents=True)
        write_sheet(paths[2], self.measurement, self.cameras)
        write_calibration_recording(paths[3], self.measurement, self.text())
        write_calibration(paths[0], self.rig, self.facts)
        return paths


def corrected_rig(rig: CameraRig, cameras: Items[CameraEstimate]) -> CameraRig:
    """The rig with the changes of the cameras whose verdict is "corrected"."""
    stated, changes = [camera.ego_from_camera for camera in rig.cameras], [each.change for each in cameras]
    poses = moved(np.stack(stated), np.stack(changes))
    corrected = (
        replace(camera, ego_from_camera=pose) if each.verdict is Verdict.CORRECTED else camera
        for camera, pose, each in zip(rig.cameras, poses, cameras, strict=True)
    )
    return replace(rig, cameras=tuple(corrected))


class CorrectedDrive(DerivedSequence):
    """The drive of a calibration, with its corrected rig in every frame."""

    def __init__(self, sequence: Sequence, result: CalibrationResult) -> None:
        super().__init__(sequence)
        self.rig = result.rig

    def load(self, place: int) -> Frame:
        """The frame at a place, with the corrected rig."""
        return replace(self.sequence.load(place), rig=self.rig)
