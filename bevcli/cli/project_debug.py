"""`bevcli project-debug`: what is wrong with a calibration, in words and images."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from bevcli.rig.checks import RigReport
    from bevcli.rig.inspection import DebugInput

ERRORS_FOUND = 3


def project_debug(
    calibration: Annotated[Path, typer.Argument(help="A calibration.json, or a sequence with one.")],
    sequence: Annotated[
        Path | None, typer.Option(help="A sequence folder whose images and ego-motion go with the calibration.")
    ] = None,
    frame: Annotated[int, typer.Option(min=0, help="Whose images to draw on: its place in the sequence.")] = 0,
    out: Annotated[
        Path | None,
        typer.Option(help="Where the images go. Default: runs/<name>-project-debug.", show_default=False),
    ] = None,
    json: Annotated[
        bool, typer.Option("--json", help="Print the findings and the coverage as one JSON object.")
    ] = False,
) -> None:
    """Find the mistake in a calibration.

    Checks the cameras' poses and lenses, the bev frame and, with a sequence, its ego-motion and times. Writes
    cameras.png (pillars, ground and horizon in every image), coverage.png (how many cameras see each BEV cell),
    recording.rrd (all of it, for bevcli viz) and findings.json. Files of an earlier look are overwritten.

    Exit code 0 without errors, 3 with findings of severity error.
    """
    import json as json_format

    from bevcli.cli.project_debug_text import report_text
    from bevcli.findings import errors_of
    from bevcli.rig.checks import check_rig, with_findings
    from bevcli.rig.inspection import gather

    given = gather(calibration, sequence, frame)
    report = with_findings(check_rig(given.rig, given.rig_findings), given.sequence_findings)
    folder = out or Path("runs") / f"{given.name}-project-debug"
    document = json_format.dumps(report_to_json(report), indent=1, ensure_ascii=False)
    written = _write(folder, given, report, document)
    if json:
        print(document)
    else:
        print(report_text(given.name, given.rig, report), "", "Written: " + ", ".join(written), sep="\n")
    if errors_of(report.findings):
        raise typer.Exit(ERRORS_FOUND)


def report_to_json(report: RigReport) -> dict[str, Any]:
    """The object of --json: "findings", a list, and "coverage"."""
    import numpy as np

    coverage = report.coverage
    grid, counts = coverage.grid, np.bincount(coverage.counts.ravel())
    fields = ("code", "severity", "camera", "message", "found", "expected", "advice")
    return {
        "findings": [{name: getattr(finding, name) for name in fields} for finding in report.findings],
        "coverage": {
            "rows": grid.rows,
            "columns": grid.columns,
            "x_range_m": list(grid.x_range_m),
            "y_range_m": list(grid.y_range_m),
            "unseen": round(coverage.unseen, 6),
            "cells_by_cameras": {str(cameras): int(cells) for cameras, cells in enumerate(counts)},
            "seen_by_camera": {name: round(share, 6) for name, share in coverage.shares.items()},
        },
    }


def _write(folder: Path, given: DebugInput, report: RigReport, document: str) -> list[str]:
    """Write all files into the folder, and name them. Without a camera there are no images."""
    from bevcli.errors import OutputError
    from bevcli.rig.coverage_map import write_coverage_map
    from bevcli.rig.recording import write_calibration_recording
    from bevcli.rig.sheet import write_sheet

    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "findings.json").write_text(document + "\n", encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written: {error.strerror}") from error
    if not given.rig.cameras:
        return [str(folder / "findings.json")]
    write_sheet(folder / "cameras.png", given.rig, report, given.images)
    write_coverage_map(folder / "coverage.png", given.rig, report.coverage)
    write_calibration_recording(folder / "recording.rrd", given.rig, report, given.images)
    return [str(folder / name) for name in ("cameras.png", "coverage.png", "recording.rrd", "findings.json")]
