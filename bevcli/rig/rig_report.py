"""All checks of a rig in their order, the findings that suppress others, and the report for the terminal."""

import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from bevcli.findings import SEVERITIES, Finding, errors_of
from bevcli.geometry.cameras import Camera, CameraRig
from bevcli.printing import aligned, counted
from bevcli.rig.bev_checks import check_bev_frame
from bevcli.rig.coverage import Coverage, Measure, check_coverage, check_measures, coverage_of, measures_of
from bevcli.rig.lens_checks import check_lenses
from bevcli.rig.mounting import degrees_text, mounting_of, seen_fov_deg
from bevcli.rig.pose_checks import check_names, check_poses, corrected

BEV_ASSUMED = Finding(
    "bev-assumed", "info", None, 'the calibration has no "ego_from_bev"',
    advice="the default is used: a level frame at (0.94, 0, 1.84) m, x right, y forward",
)  # fmt: skip
MERGED_FROM = 3  # cameras with the same mistake: from this many on it is one finding on the whole rig
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

    Consequences of a reported error are suppressed: a camera with an error from reading is not checked again, names are
    compared only for cameras with plausible poses, and coverage and the comparison with nuScenes are reported only
    where there is no error.
    """
    findings = _findings(rig, found_before)
    coverage = coverage_of(rig)
    measures: tuple[Measure, ...] = ()
    if rig.cameras and not errors_of(findings):
        measures = measures_of(rig.cameras, coverage)
        findings += [*check_coverage(coverage, rig.ego_from_bev), *check_measures(measures)]
    return RigReport(_by_severity(findings), coverage, measures)


def rig_errors(rig: CameraRig) -> tuple[Finding, ...]:
    """The errors that `check_rig` finds, without the time that the coverage takes."""
    return errors_of(_findings(rig, ()))


def _findings(rig: CameraRig, found_before: Sequence[Finding]) -> list[Finding]:
    """All findings but those about coverage and the comparison with nuScenes."""
    cameras = _without_errors(rig.cameras, found_before)
    poses, lenses = check_poses(cameras), check_lenses(cameras)
    names = check_names(_without_errors(cameras, poses)) + _names_behind(poses, cameras)
    rig_has_error = any(finding.camera is None for finding in errors_of(found_before))
    bev = () if rig_has_error else check_bev_frame(rig.ego_from_bev)
    findings = [*found_before, *_merged(poses, cameras), *_merged(lenses, cameras), *names, *bev]
    if rig.ego_from_bev_assumed:
        findings.append(BEV_ASSUMED)
    return findings


def _names_behind(poses: Sequence[Finding], cameras: Sequence[Camera]) -> tuple[Finding, ...]:
    """Swapped names of cameras whose poses share another mistake, such as all inverted: seen once that is undone."""
    swapped = [one for one in check_names(corrected(cameras)) if one.code == "swapped-names"] if poses else []
    return tuple(replace(one, advice=f"{one.advice}, after correcting the poses") for one in swapped)


def with_findings(report: RigReport, findings: Sequence[Finding]) -> RigReport:
    """The report with more findings, such as those about a sequence."""
    return replace(report, findings=_by_severity([*report.findings, *findings]))


def _by_severity(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Errors, then warnings, then infos; findings of one severity keep their order."""
    return tuple(sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity)))


def _without_errors(cameras: Sequence[Camera], findings: Iterable[Finding]) -> tuple[Camera, ...]:
    """The cameras that no error names."""
    wrong = {finding.camera for finding in errors_of(findings)}
    return tuple(camera for camera in cameras if camera.name not in wrong)


def _merged(findings: Sequence[Finding], cameras: Sequence[Camera]) -> list[Finding]:
    """Findings with the same code and message on three or more cameras, or on all of several, become one on the rig."""
    groups: dict[tuple[str, str], list[Finding]] = {}
    for finding in findings:
        groups.setdefault((finding.code, finding.message), []).append(finding)
    merged: list[Finding] = []
    for group in groups.values():
        if len(group) >= MERGED_FROM or len(group) == len(cameras) > 1:
            names = ", ".join(str(finding.camera) for finding in group)
            found = f"{group[0].camera}: {group[0].found}"
            merged.append(replace(group[0], camera=None, message=f"{group[0].message} ({names})", found=found))
        else:
            merged += group
    return merged


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
        x, y, z = mounting.position
        size, fov = f"{camera.width}x{camera.height}", f"{seen_fov_deg(camera)[0]:.0f}°"
        angles = (degrees_text(mounting.yaw_deg, 0), degrees_text(mounting.pitch_deg), degrees_text(mounting.roll_deg))
        lens = camera.distortion.model if camera.distortion else "pinhole"
        seen = f"{coverage.shares[camera.name]:.0%}"
        rows.append((camera.name, size, fov, *angles, f"{x:.2f}", f"{y:.2f}", f"{z:.2f} m", lens, seen))
    return aligned([header, *rows], left=(0, 9))


def _finding_lines(findings: Sequence[Finding]) -> list[str]:
    if not findings:
        return ["No findings: the rig is plausible."]
    counts = {severity: sum(f.severity == severity for f in findings) for severity in SEVERITIES}
    total = ", ".join(f"{count} {severity}{'s' if count != 1 else ''}" for severity, count in counts.items() if count)
    lines = [f"Findings: {total}"]
    for finding in findings:
        where = f"{finding.camera}: " if finding.camera else ""
        head = f"{finding.severity:<9} {where}{finding.message}  [{finding.code}]"
        lines.append("")
        lines += textwrap.wrap(head, WIDTH, subsequent_indent=INDENT, break_long_words=False, break_on_hyphens=False)
        for word, value in (("found", finding.found), ("expected", finding.expected), ("do", finding.advice)):
            if value:
                text = f"{word + ':':<9} {value}"
                lines += textwrap.wrap(text, WIDTH, initial_indent=INDENT, subsequent_indent=INDENT * 2)
    return lines
