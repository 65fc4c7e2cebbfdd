"""The report on a rig: findings, the BEV cells that the cameras see, and the rig next to nuScenes'.

Published weights know no rig but nuScenes'.
"""

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bevcli.findings import SEVERITIES, Finding, errors_of
from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.cameras import Camera, CameraRig
from bevcli.geometry.transforms import Array, apply
from bevcli.printing import aligned, counted
from bevcli.rig.rig_checks import degrees_text, mounting_of, seen_fov_deg, side_of
from bevcli.rig.sequence_checks import rig_findings

COVERAGE_GRID = BevGrid(rows=100, columns=100)
UNSEEN_WARNING = 0.02
ADVICE = "expect worse results with published weights, or train on this rig"


@dataclass(frozen=True)
class Coverage:
    """The cells of a BEV grid that the cameras see.

    Attributes:
        grid: the BEV grid.
        counts: (rows, columns), the number of cameras that see at least one point of the cell's pillar.
        shares: by camera, the share of all cells that it sees, 0 to 1.
    """

    grid: BevGrid
    counts: NDArray[np.int64]
    shares: Mapping[str, float]

    @property
    def unseen(self) -> float:
        """The share of cells that no camera sees, 0 to 1."""
        return float((self.counts == 0).mean())

    @property
    def overlap(self) -> float:
        """The share of cells that two or more cameras see, 0 to 1."""
        return float((self.counts >= 2).mean())


def pixels_in_image(camera: Camera, points_ego: Array) -> Array:
    """Points (..., 3) in the ego frame -> pixels (..., 2), NaN for points outside the image."""
    pixels, depth = camera.project_ego(points_ego)
    return np.where(camera.contains(pixels, depth)[..., None], pixels, np.nan)


def coverage_of(rig: CameraRig, grid: BevGrid = COVERAGE_GRID) -> Coverage:
    """The coverage of a grid by a rig, with all images taken at the same time and without occlusion."""
    pillars = apply(rig.ego_from_bev, grid.pillars())  # (Y, X, Z, 3)
    counts = np.zeros((grid.rows, grid.columns), dtype=np.int64)
    shares = {}
    for camera in rig.cameras:
        seen = camera.sees(pillars).any(-1)  # (Y, X)
        counts += seen
        shares[camera.name] = float(seen.mean())
    return Coverage(grid, counts, shares)


def check_coverage(coverage: Coverage, ego_from_bev: Array) -> tuple[Finding, ...]:
    """One finding if some cells are seen by no camera; no error, because a rig may have few cameras on purpose."""
    if coverage.unseen == 0:
        return ()
    empty = coverage.grid.cell_centers()[coverage.counts == 0]
    center = np.append(empty.mean(0), 0) @ ego_from_bev[:3, :3].T
    yaw = float(np.degrees(np.arctan2(center[1], center[0])))
    around = np.hypot(center[0], center[1]) < 0.1 * (coverage.grid.x_range_m[1] - coverage.grid.x_range_m[0])
    side = "all around" if around else f"mostly {side_of(yaw)}"
    return (
        Finding(
            "cells-unseen", "warning" if coverage.unseen > UNSEEN_WARNING else "info", None,
            "some BEV cells are seen by no camera",
            f"{coverage.unseen:.1%} of the cells, {side}", "0%", "nothing is detected there: see the coverage map",
        ),
    )  # fmt: skip


@dataclass(frozen=True)
class Measure:
    """One property of a rig, as a range over its cameras."""

    code: str  # of the finding when the property is far from nuScenes'
    name: str  # of the property
    unit: str  # of all numbers
    lowest: float  # smallest value of any camera
    highest: float  # largest value of any camera
    nuscenes: tuple[float, float]  # lowest and highest in nuScenes
    near: tuple[float, float]  # range of values that is similar to nuScenes

    @property
    def is_near(self) -> bool:
        """True if every camera is in the range that is similar to nuScenes."""
        return self.near[0] <= self.lowest and self.highest <= self.near[1]

    @property
    def value(self) -> str:
        """The range as text, such as "1.49 to 1.57 m"."""
        return _range_text(self.lowest, self.highest, self.unit)

    @property
    def reference(self) -> str:
        """nuScenes' range as text."""
        return _range_text(*self.nuscenes, self.unit)


def measures_of(cameras: Sequence[Camera], coverage: Coverage) -> tuple[Measure, ...]:
    """Height, pitch, roll, field of view and overlap of a rig with at least one camera.

    nuScenes' values were measured with these functions on one of its vehicles.
    """
    mountings = [mounting_of(camera.ego_from_camera) for camera in cameras]
    fovs = [seen_fov_deg(camera)[0] for camera in cameras]
    seen, overlap = 100 * (1 - coverage.unseen), 100 * coverage.overlap
    rows: tuple[tuple[str, str, str, list[float], tuple[float, float], tuple[float, float]], ...] = (
        ("height-far", "camera height", "m", [m.height for m in mountings], (1.49, 1.57), (1.0, 2.2)),
        ("pitch-far", "pitch", "°", [m.pitch_deg for m in mountings], (0.3, 1.2), (-8.0, 8.0)),
        ("roll-far", "roll", "°", [m.roll_deg for m in mountings], (-0.6, 0.9), (-6.0, 6.0)),
        ("fov-far", "field of view", "°", fovs, (64.9, 90.1), (45.0, 115.0)),
        ("cells-seen", "cells seen", "%", [seen], (99.8, 99.8), (95.0, 100.0)),
        ("overlap-far", "cells seen twice", "%", [overlap], (13.8, 13.8), (5.0, 40.0)),
    )
    return tuple(
        Measure(code, name, unit, float(np.min(values)), float(np.max(values)), nuscenes, near)
        for code, name, unit, values, nuscenes, near in rows
    )


def check_measures(measures: Sequence[Measure]) -> tuple[Finding, ...]:
    """A warning for every property that is far from nuScenes', but for unseen cells: `check_coverage` reports them."""
    far = [measure for measure in measures if not measure.is_near and measure.code != "cells-seen"]
    return tuple(
        Finding(m.code, "warning", None, f"{m.name}: far from nuScenes'", m.value, m.reference, ADVICE) for m in far
    )


def _range_text(low: float, high: float, unit: str) -> str:
    digits = 2 if unit == "m" else 1
    first, last = (f"{round(value, digits) + 0.0:.{digits}f}" for value in (low, high))  # + 0.0: zero has no sign
    gap = " " if unit == "m" else ""
    return f"{first}{gap}{unit}" if first == last else f"{first} to {last}{gap}{unit}"


WIDTH = 100
INDENT = " " * 10


@dataclass(frozen=True)
class RigReport:
    """The results of the checks of a rig.

    Attributes:
        findings: errors first, then warnings, then infos.
        coverage: how many cameras see each cell of the BEV grid.
        measures: the rig next to nuScenes'; empty where errors make the comparison meaningless.
    """

    findings: tuple[Finding, ...]
    coverage: Coverage
    measures: tuple[Measure, ...]


def check_rig(rig: CameraRig, found_before: Sequence[Finding] = ()) -> RigReport:
    """Run all checks of a rig. found_before: findings from reading the file.

    Coverage and the comparison with nuScenes are reported only where there is no error.
    """
    findings = rig_findings(rig, found_before)
    coverage = coverage_of(rig)
    measures: tuple[Measure, ...] = ()
    if rig.cameras and not errors_of(findings):
        measures = measures_of(rig.cameras, coverage)
        findings += [*check_coverage(coverage, rig.ego_from_bev), *check_measures(measures)]
    return RigReport(_by_severity(findings), coverage, measures)


def with_findings(report: RigReport, findings: Sequence[Finding]) -> RigReport:
    """The report with more findings, such as those about a sequence."""
    return replace(report, findings=_by_severity([*report.findings, *findings]))


def _by_severity(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Errors, then warnings, then infos; findings of one severity keep their order."""
    return tuple(sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity)))


def report_text(name: str, rig: CameraRig, report: RigReport) -> str:
    """The report as plain text, wrapped at 100 columns."""
    coverage = report.coverage
    once = 1 - coverage.unseen - coverage.overlap
    seen = f"{coverage.unseen:.1%} of the cells seen by no camera, {once:.1%} by one, {coverage.overlap:.1%} by more"
    parts = [f"{name}: {counted(len(rig.cameras), 'cameras')}", "", _cameras(rig, coverage), "", f"BEV grid: {seen}"]
    parts += ["", *_finding_lines(report.findings)]
    if report.measures:
        rows = [("compared with nuScenes", "this rig", "nuScenes", "")]
        rows += [(m.name, m.value, m.reference, "" if m.is_near else "far") for m in report.measures]
        parts += ["", aligned(rows, left=(0, 3))]
    return "\n".join(parts)


def _cameras(rig: CameraRig, coverage: Coverage) -> str:
    header = ("camera", "image", "FOV", "yaw", "pitch", "roll", "x", "y", "height", "lens", "sees")
    rows = []
    for camera in rig.cameras:
        mounting = mounting_of(camera.ego_from_camera)
        size, fov = f"{camera.width}x{camera.height}", f"{seen_fov_deg(camera)[0]:.0f}°"
        angles = (degrees_text(mounting.yaw_deg, 0), degrees_text(mounting.pitch_deg), degrees_text(mounting.roll_deg))
        lens = camera.distortion.model if camera.distortion else "pinhole"
        seen = f"{coverage.shares[camera.name]:.0%}"
        position = (f"{mounting.x:.2f}", f"{mounting.y:.2f}", f"{mounting.height:.2f} m")
        rows.append((camera.name, size, fov, *angles, *position, lens, seen))
    return aligned([header, *rows], left=(0, 9))


def _finding_lines(findings: Sequence[Finding]) -> list[str]:
    if not findings:
        return ["No findings: the rig is plausible."]
    counts = {severity: sum(f.severity == severity for f in findings) for severity in SEVERITIES}
    total = ", ".join(f"{count} {severity}{'s' if count != 1 else ''}" for severity, count in counts.items() if count)
    lines = [f"Findings: {total}"]
    for finding in findings:
        camera = f"{finding.camera}: " if finding.camera else ""
        head = f"{finding.severity:<9} {camera}{finding.message}  [{finding.code}]"
        lines.append("")
        lines += textwrap.wrap(head, WIDTH, subsequent_indent=INDENT, break_long_words=False, break_on_hyphens=False)
        for word, value in (("found", finding.found), ("expected", finding.expected), ("do", finding.advice)):
            if value:
                text = f"{word + ':':<9} {value}"
                lines += textwrap.wrap(text, WIDTH, initial_indent=INDENT, subsequent_indent=INDENT * 2)
    return lines
