"""`check_calibration`: read a calibration, run all checks, and keep what they found."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import OutputError
from bevcli.findings import Finding, errors_of
from bevcli.geometry.cameras import CameraRig
from bevcli.rig.coverage import Coverage
from bevcli.rig.inputs import read_inputs
from bevcli.rig.report_text import report_text
from bevcli.rig.rig_report import RigReport, check_rig, with_findings


@dataclass(frozen=True)
class CalibrationCheck:
    """The result of `check_calibration`.

    Attributes:
        name: of the calibration file or the sequence.
        rig: the cameras that could be read.
        report: the findings, the coverage of the BEV grid, and the comparison with nuScenes.
        images: by camera, (H, W, 3) uint8 BGR, of the chosen frame; empty without a sequence.
    """

    name: str
    rig: CameraRig
    report: RigReport
    images: Mapping[str, NDArray[np.uint8]]

    @property
    def findings(self) -> tuple[Finding, ...]:
        """All findings: errors first, then warnings, then infos."""
        return self.report.findings

    @property
    def errors(self) -> tuple[Finding, ...]:
        """The findings of severity error."""
        return errors_of(self.findings)

    def text(self) -> str:
        """The rig, its coverage and the findings as plain text for a terminal."""
        return report_text(self.name, self.rig, self.report)

    def to_json(self) -> str:
        """The findings and the coverage as one JSON object, the content of findings.json."""
        content = {
            "findings": [asdict(finding) for finding in self.findings],
            "coverage": _coverage_to_json(self.report.coverage),
        }
        return json.dumps(content, indent=1, ensure_ascii=False)

    def write(self, folder: Path | str) -> list[Path]:
        """Write cameras.png, coverage.png, recording.rrd and findings.json into a folder, made where it is missing.

        Existing files are overwritten. Without any camera there is only findings.json. Returns the files' paths. Raises
        OutputError where a file cannot be written.
        """
        # Only writing draws: matplotlib and rerun take a second to load.
        from bevcli.rig.camera_sheet import write_camera_sheet
        from bevcli.rig.coverage_map import write_coverage_map
        from bevcli.rig.rig_recording import write_rig_recording

        folder = Path(folder)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            (folder / "findings.json").write_text(self.to_json() + "\n", encoding="utf-8")
        except OSError as error:
            raise OutputError(f"{folder}: cannot be written: {error.strerror}") from error
        if not self.rig.cameras:
            return [folder / "findings.json"]
        write_camera_sheet(folder / "cameras.png", self.rig, self.report, self.images)
        write_coverage_map(folder / "coverage.png", self.rig, self.report.coverage)
        write_rig_recording(folder / "recording.rrd", self.rig, self.report, self.images)
        return [folder / name for name in ("cameras.png", "coverage.png", "recording.rrd", "findings.json")]


def check_calibration(
    path: Path | str, sequence: Path | str | None = None, frame: int = 0, **options: Any
) -> CalibrationCheck:
    """Find the mistakes in a calibration.

    Args:
        path: a calibration.json, a sequence folder that contains one, a nuScenes root, or a ROS bag.
        sequence: a sequence folder or bag whose images, ego-motion and timestamps belong to the calibration.
        frame: index of the frame in the sequence whose images are kept, from 0.
        options: of `open_sequence`, for a nuScenes root or a bag, such as topics.

    Returns:
        The findings with what is needed to draw them. Mistakes in the calibration are findings, not exceptions.

    Raises:
        InputError: the file is missing or not a JSON object, or the sequence has no such frame.
    """
    inputs = read_inputs(Path(path), None if sequence is None else Path(sequence), frame, options)
    report = with_findings(check_rig(inputs.rig, inputs.rig_findings), inputs.sequence_findings)
    return CalibrationCheck(inputs.name, inputs.rig, report, inputs.images)


def _coverage_to_json(coverage: Coverage) -> dict[str, Any]:
    counts = np.bincount(coverage.counts.ravel())
    return {
        "rows": coverage.grid.rows,
        "columns": coverage.grid.columns,
        "x_range_m": list(coverage.grid.x_range_m),
        "y_range_m": list(coverage.grid.y_range_m),
        "unseen": round(coverage.unseen, 6),
        "cells_by_cameras": {str(cameras): int(cells) for cameras, cells in enumerate(counts)},
        "seen_by_camera": {name: round(share, 6) for name, share in coverage.shares.items()},
    }
