"""All checks of a rig, in their order, and which findings suppress others."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from bevcli.findings import SEVERITIES, Finding, errors_of
from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.cameras import Camera, CameraRig
from bevcli.rig.bev_checks import check_bev_frame
from bevcli.rig.coverage import COVERAGE_GRID, Coverage, check_coverage, coverage_of
from bevcli.rig.lens_checks import check_lenses
from bevcli.rig.name_checks import check_names
from bevcli.rig.nuscenes_comparison import Measure, check_measures, measures_of
from bevcli.rig.pose_checks import check_poses, corrected

MERGED_FROM = 3  # cameras with the same mistake: from this many on it is one finding on the whole rig


@dataclass(frozen=True)
class RigReport:
    """What the checks of a rig found.

    Attributes:
        findings: errors first, then warnings, then infos.
        coverage: how many cameras see each cell of the BEV grid.
        measures: the rig next to nuScenes'; empty where errors make the comparison meaningless.
    """

    findings: tuple[Finding, ...]
    coverage: Coverage
    measures: tuple[Measure, ...]


def check_rig(rig: CameraRig, found_before: Sequence[Finding] = (), grid: BevGrid = COVERAGE_GRID) -> RigReport:
    """Run all checks of a rig.

    found_before: findings from reading the file. grid: the BEV grid whose coverage is computed.

    Consequences of a reported error are suppressed: a camera with an error from reading is not checked again, names are
    compared only for cameras with plausible poses, and coverage and the comparison with nuScenes are reported only
    where there is no error.
    """
    cameras = _without_errors(rig.cameras, found_before)
    poses, lenses = check_poses(cameras), check_lenses(cameras)
    names = check_names(_without_errors(cameras, poses)) + _names_behind(poses, cameras)
    rig_has_error = any(finding.camera is None for finding in errors_of(found_before))
    bev = () if rig_has_error else check_bev_frame(rig.ego_from_bev)
    findings = [*found_before, *_merged(poses, cameras), *_merged(lenses, cameras), *names, *bev]
    if rig.ego_from_bev_assumed:
        findings.append(_assumed())
    coverage = coverage_of(rig, grid)
    measures: tuple[Measure, ...] = ()
    if rig.cameras and not errors_of(findings):
        measures = measures_of(rig.cameras, coverage)
        findings += [*check_coverage(coverage, rig.ego_from_bev), *check_measures(measures)]
    return RigReport(_by_severity(findings), coverage, measures)


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


def _assumed() -> Finding:
    return Finding(
        "bev-assumed",
        "info",
        None,
        'the calibration has no "ego_from_bev"',
        advice="the default is used: a level frame at (0.94, 0, 1.84) m, x right, y forward",
    )
