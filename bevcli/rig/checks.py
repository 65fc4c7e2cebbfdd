"""All checks of a rig, in the order in which causes come before what they lead to."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from bevcli.findings import SEVERITIES, Finding, errors_of
from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.cameras import Camera, CameraRig
from bevcli.rig.bev_checks import check_bev_frame
from bevcli.rig.coverage import COVERAGE_GRID, Coverage, check_coverage, coverage_of
from bevcli.rig.distance import Measure, check_distance, measures_of
from bevcli.rig.lens_checks import check_lenses
from bevcli.rig.names import check_names
from bevcli.rig.pose_checks import check_poses

MERGED = 3  # so many cameras with one mistake have one cause


@dataclass(frozen=True)
class RigReport:
    """findings: the gravest first. measures: the rig against nuScenes'; empty where errors make them meaningless."""

    findings: tuple[Finding, ...]
    coverage: Coverage
    measures: tuple[Measure, ...]


def check_rig(rig: CameraRig, found_before: Sequence[Finding] = (), grid: BevGrid = COVERAGE_GRID) -> RigReport:
    """Check a rig. A cause silences its consequences.

    found_before: what reading the file found. A camera named there is not judged further. Names are compared only of
    cameras whose poses are plausible, and coverage and distance from nuScenes only where there is no error.
    """
    cameras = _without(rig.cameras, found_before)
    poses, lenses = check_poses(cameras), check_lenses(cameras)
    names = check_names(_without(cameras, poses))
    bev = () if _has_error(found_before, None) else check_bev_frame(rig.ego_from_bev)
    findings = [*found_before, *_merged(poses, cameras), *_merged(lenses, cameras), *names, *bev]
    if rig.ego_from_bev_assumed:
        findings.append(_assumed())
    coverage = coverage_of(rig, grid)
    measures: tuple[Measure, ...] = ()
    if rig.cameras and not errors_of(findings):
        measures = measures_of(rig.cameras, coverage)
        findings += [*check_coverage(coverage, rig.ego_from_bev), *check_distance(measures)]
    return RigReport(sorted_by_severity(findings), coverage, measures)


def with_findings(report: RigReport, findings: Sequence[Finding]) -> RigReport:
    """The report with more findings, as a sequence's."""
    return replace(report, findings=sorted_by_severity([*report.findings, *findings]))


def sorted_by_severity(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Errors, then warnings, then infos; otherwise in their order."""
    return tuple(sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity)))


def _without(cameras: Sequence[Camera], findings: Iterable[Finding]) -> tuple[Camera, ...]:
    """The cameras of which no error was found."""
    wrong = {finding.camera for finding in errors_of(findings)}
    return tuple(camera for camera in cameras if camera.name not in wrong)


def _has_error(findings: Iterable[Finding], camera: str | None) -> bool:
    return any(finding.camera == camera for finding in errors_of(findings))


def _merged(findings: Sequence[Finding], cameras: Sequence[Camera]) -> list[Finding]:
    """Findings of one code and message on three cameras or more, or on all of several, as one on the whole rig."""
    groups: dict[tuple[str, str], list[Finding]] = {}
    for finding in findings:
        groups.setdefault((finding.code, finding.message), []).append(finding)
    merged: list[Finding] = []
    for group in groups.values():
        if len(group) >= MERGED or len(group) == len(cameras) > 1:
            names = ", ".join(str(finding.camera) for finding in group)
            found = f"{group[0].camera}: {group[0].found}"
            merged.append(replace(group[0], camera=None, message=f"{group[0].message} ({names})", found=found))
        else:
            merged += group
    return merged


def _assumed() -> Finding:
    return Finding(
        "bev-assumed", "info", None, 'the calibration has no "ego_from_bev"', "",
        "", "a level frame at (0.94, 0, 1.84) m, x right, y forward, is taken",
    )  # fmt: skip
