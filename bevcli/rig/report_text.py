"""The report for the terminal: the rig, its coverage, the findings, and the comparison with nuScenes."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

from bevcli.findings import SEVERITIES, Finding
from bevcli.geometry.cameras import CameraRig
from bevcli.rig.coverage import Coverage
from bevcli.rig.mounting import degrees_text, mounting_of, seen_fov_deg
from bevcli.rig.rig_report import RigReport

WIDTH = 100
INDENT = " " * 10


def report_text(name: str, rig: CameraRig, report: RigReport) -> str:
    """The report as plain text, wrapped at 100 columns."""
    parts = [
        f"{name}: {len(rig.cameras)} cameras",
        "",
        *_rig_lines(rig, report.coverage),
        "",
        *_coverage_lines(report.coverage),
    ]
    parts += ["", *_finding_lines(report.findings)]
    if report.measures:
        parts += ["", *_measure_lines(report)]
    return "\n".join(parts)


def _rig_lines(rig: CameraRig, coverage: Coverage) -> list[str]:
    header = ("camera", "image", "FOV", "yaw", "pitch", "roll", "x", "y", "height", "lens", "sees")
    rows = []
    for camera in rig.cameras:
        mounting = mounting_of(camera.ego_from_camera)
        x, y, z = mounting.position
        rows.append(
            (
                camera.name,
                f"{camera.width}x{camera.height}",
                f"{seen_fov_deg(camera)[0]:.0f}°",
                degrees_text(mounting.yaw_deg, 0),
                degrees_text(mounting.pitch_deg),
                degrees_text(mounting.roll_deg),
                f"{x:.2f}",
                f"{y:.2f}",
                f"{z:.2f} m",
                camera.distortion.model if camera.distortion else "pinhole",
                f"{coverage.shares[camera.name]:.0%}",
            )
        )
    return _table([header, *rows], left={0, 9})


def _coverage_lines(coverage: Coverage) -> list[str]:
    seen_once = 1 - coverage.unseen - coverage.overlap
    text = (
        f"{coverage.unseen:.1%} of the cells seen by no camera, {seen_once:.1%} by one, {coverage.overlap:.1%} by more"
    )
    return [f"BEV grid: {text}"]


def _finding_lines(findings: Sequence[Finding]) -> list[str]:
    if not findings:
        return ["No findings: the rig is plausible."]
    counts = {severity: sum(f.severity == severity for f in findings) for severity in SEVERITIES}
    total = ", ".join(f"{count} {severity}{'s' if count != 1 else ''}" for severity, count in counts.items() if count)
    lines = [f"Findings: {total}"]
    for finding in findings:
        where = f"{finding.camera}: " if finding.camera else ""
        head = f"{finding.severity:<9} {where}{finding.message}  [{finding.code}]"
        lines += [
            "",
            *textwrap.wrap(head, WIDTH, subsequent_indent=INDENT, break_long_words=False, break_on_hyphens=False),
        ]
        for word, value in (("found", finding.found), ("expected", finding.expected), ("do", finding.advice)):
            if value:
                text = f"{word + ':':<9} {value}"
                lines += textwrap.wrap(text, WIDTH, initial_indent=INDENT, subsequent_indent=INDENT * 2)
    return lines


def _measure_lines(report: RigReport) -> list[str]:
    rows = [("compared with nuScenes", "this rig", "nuScenes", "")]
    rows += [(m.name, m.value, m.reference, "" if m.is_near else "far") for m in report.measures]
    return _table(rows, left={0, 3})


def _table(rows: Sequence[Sequence[str]], left: set[int]) -> list[str]:
    """Rows as aligned columns. left: indices of the columns that are aligned to the left, all others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            cell.ljust(width) if place in left else cell.rjust(width)
            for place, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]
