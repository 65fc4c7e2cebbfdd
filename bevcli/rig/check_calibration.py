"""`check_calibration`: read a calibration and the data of its sequence, run all checks, and keep what they found.

The times of the images are checked here.
"""

import json
import os
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bevcli.config import load_config
from bevcli.errors import SEVERITIES, Finding, InputError, errors_of
from bevcli.frame import Frame, FrameStamp
from bevcli.geometry.cameras import CameraRig
from bevcli.model.config import training_rig_notes
from bevcli.options import defaults
from bevcli.printing import aligned, counted
from bevcli.rig import drawings
from bevcli.rig.coverage import Coverage, Measure, check_coverage, check_measures, coverage_of, measures_of
from bevcli.rig.rig_checks import degrees_text, mounting_of, seen_fov_deg
from bevcli.rig.sequence_checks import check_scenes, rig_findings
from bevcli.sequences.files.calibration_file import CALIBRATION, OF_RIG, RigDraft, draft_of, draft_rig
from bevcli.sequences.format import format_of, is_drive
from bevcli.sequences.native import FolderOptions, NativeFolder
from bevcli.sequences.native.folder import FolderDrive, read_frames_table
from bevcli.sequences.open import open_sequence
from bevcli.sequences.options import InputOptions
from bevcli.writing import write_whole

OFFSET_WARNING_S = 0.1  # nuScenes' cameras are within 0.05 s of the frame
OFFSET_ERROR_S = 0.5
JITTER_WARNING_S = 0.05


WIDTH = 100
INDENT = " " * 10


@dataclass(frozen=True)
class CalibrationCheck:
    """The result of `check_calibration`."""

    name: str  # of the calibration file or the sequence
    rig: CameraRig  # the cameras that could be read
    findings: tuple[Finding, ...]  # errors first, then warnings, then infos
    coverage: Coverage  # how many cameras see each cell of the BEV grid
    measures: tuple[Measure, ...]  # the rig next to nuScenes'; empty where errors make the comparison meaningless
    # by camera, (H, W, 3) uint8 BGR, of the chosen frame; empty without a sequence
    images: Mapping[str, NDArray[np.uint8]]

    @property
    def errors(self) -> tuple[Finding, ...]:
        """The findings of severity error."""
        return errors_of(self.findings)

    def with_findings(self, findings: Iterable[Finding]) -> "CalibrationCheck":
        """The check with more findings, such as those about a sequence."""
        return replace(self, findings=_by_severity([*self.findings, *findings]))

    def text(self) -> str:
        """The rig, its coverage and the findings as plain text for a terminal."""
        return _text(self)

    def to_json(self) -> str:
        """The findings and the coverage as one JSON object, the content of findings.json."""
        findings = [asdict(finding) for finding in self.findings]
        content = {"findings": findings, "coverage": _coverage_to_json(self.coverage)}
        return json.dumps(content, indent=1, ensure_ascii=False)

    def write(self, folder: Path | str) -> list[Path]:
        """Write cameras.png, coverage.png, recording.rrd and findings.json into a folder, made where it is missing.

        Existing files are overwritten. Without any camera there is only findings.json. Returns the files' paths. Raises
        OutputError where a file cannot be written.
        """
        folder = Path(folder)
        write_whole(folder / "findings.json", f"{self.to_json()}\n".encode(), parents=True)
        if not self.rig.cameras:
            return [folder / "findings.json"]
        drawings.write_camera_sheet(folder / "cameras.png", self.rig, self.findings, self.coverage, self.images)
        drawings.write_coverage_map(folder / "coverage.png", self.rig, self.coverage)
        drawings.write_rig_recording(
            folder / "recording.rrd", self.rig, self.findings, self.coverage, self.measures, self.images
        )
        return [folder / name for name in ("cameras.png", "coverage.png", "recording.rrd", "findings.json")]


def check_rig(
    rig: CameraRig,
    found_before: Sequence[Finding] = (),
    name: str = "",
    images: Mapping[str, NDArray[np.uint8]] = MappingProxyType({}),
) -> CalibrationCheck:
    """Run all checks of a rig. found_before: findings from reading the file.

    Coverage and the comparison with nuScenes are reported only where there is no error.
    """
    findings, coverage = rig_findings(rig, found_before), coverage_of(rig)
    measures: tuple[Measure, ...] = ()
    if rig.cameras and not errors_of(findings):
        measures = measures_of(rig.cameras, coverage)
        findings += [*check_coverage(coverage, rig.ego_from_bev), *check_measures(measures)]
    return CalibrationCheck(name, rig, _by_severity(findings), coverage, measures, images)


def _by_severity(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Errors, then warnings, then infos; findings of one severity keep their order."""
    return tuple(sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity)))


def check_calibration(
    path: Path | str, sequence: Path | str | None = None, frame: int = 0, **options: Any
) -> CalibrationCheck:
    """Find the mistakes in a calibration.

    Args:
        path: a calibration of any kind, or a drive: a sequence folder, a nuScenes root, a ROS bag, a video.
        sequence: a sequence folder or bag whose images, ego-motion and timestamps belong to the calibration.
        frame: index of the frame in the sequence whose images are kept, from 0.
        options: of `open_sequence`, such as allow_outside, calibration, or topics for a bag. A native folder takes
            allow_outside and those of the rig, of images without a table and of poses.

    Returns:
        The findings with what is needed to draw them. Mistakes in the calibration are findings, not exceptions.

    Raises:
        InputError: the file is missing or not a JSON object, or the sequence has no such frame.
    """
    path, folder = Path(path), None if sequence is None else Path(sequence)
    own = FolderOptions(**{name: options[name] for name in defaults(FolderOptions) if name in options})
    if folder is None and is_drive(path):
        beside = draft_of(own, path)
        if beside is None and (_is_other_drive(path) or not (path / CALIBRATION).exists()):
            return _check_other_sequence(path, frame, options)
        if beside is not None and _is_other_drive(path):
            return _check_other_sequence(path, frame, options, () if beside.readings else beside.findings)
        draft, folder = beside or draft_rig(path / CALIBRATION, path), path
    else:
        draft = draft_rig(path, folder, **{name: options[name] for name in ("calibration", *OF_RIG) if name in options})
    if folder is None:
        draft = draft.certain()
    elif _is_other_drive(folder):
        found_before = () if draft.readings else draft.findings
        return _check_other_sequence(folder, frame, {**options, "calibration": path}, found_before)
    of_drive: tuple[Finding, ...] = ()
    images: Mapping[str, NDArray[np.uint8]] = {}
    if folder is not None and draft.rig.cameras:
        draft, of_drive, images = _read_folder(folder, draft, frame, own, outside=bool(options.get("allow_outside")))
    name = os.path.basename(os.path.realpath(folder or (path if path.is_dir() else path.with_suffix(""))))
    return check_rig(draft.rig, draft.findings, name, images).with_findings(of_drive)


def _is_other_drive(path: Path) -> bool:
    """True for a drive that is not a native folder, such as a bag."""
    return is_drive(path) and format_of(path) is not NativeFolder


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


def _check_other_sequence(
    path: Path, frame: int, options: Mapping[str, Any], found_before: Sequence[Finding] = ()
) -> CalibrationCheck:
    sequence = open_sequence(path, ego_motion="optional", ground_truth=False, **options)
    shown = sequence.load(_checked_index(sequence.stamps, frame, path))
    return check_rig(shown.rig, found_before, sequence.name, _pixels(shown)).with_findings(_missing_images(shown))


def _read_folder(
    folder: Path, draft: RigDraft, frame: int, own: FolderOptions, *, outside: bool
) -> tuple[RigDraft, tuple[Finding, ...], Mapping[str, NDArray[np.uint8]]]:
    """The rig as the images show it, the findings about a native folder, and the images by camera of one frame."""
    findings: list[Finding] = []
    options = InputOptions(ego_motion="optional", ground_truth=False, allow_outside=outside)
    try:
        sequence = FolderDrive(folder, options, own, draft)
    except InputError as error:
        findings.append(_refused(error))
        try:
            # Images may be readable without ego-motion.
            sequence = FolderDrive(folder, replace(options, ego_motion="static"), own, replace(draft, readings=()))
        except InputError:
            return draft, tuple(findings), {}
    draft = sequence.draft
    if sequence.ego_motion is not None:
        findings += check_scenes(sequence.ego_motion, sequence.stamps)
    if sequence.understood:
        findings.append(Finding("no-frames-table", "info", None, sequence.understood))
    else:
        findings += _check_times(folder / "frames.csv", draft.rig)
    index = _checked_index(sequence.stamps, frame, folder)
    try:
        shown = sequence.load(index)
    except InputError as error:
        return draft, (*findings, _refused(error)), {}
    return draft, (*findings, *_missing_images(shown)), _pixels(shown)


def _checked_index(stamps: tuple[FrameStamp, ...], frame: int, path: Path) -> int:
    if not 0 <= frame < len(stamps):
        raise InputError(f"{path}: the sequence has no frame {frame} (it has {len(stamps)} frames, counted from 0)")
    return frame


def _check_times(table: Path, rig: CameraRig) -> tuple[Finding, ...]:
    entries = read_frames_table(table, rig.names)
    sources = [entry.sources for entry in entries]
    times = {name: [of[name].timestamp_ns if name in of else None for of in sources] for name in rig.names}
    return check_camera_times([entry.stamp.timestamp_ns for entry in entries], times)


def _refused(error: InputError) -> Finding:
    advice = "fix this first: bevcli run refuses this sequence"
    return Finding("sequence-refused", "error", None, str(error), advice=advice)


def _missing_images(frame: Frame) -> tuple[Finding, ...]:
    return tuple(
        Finding("image-missing", "warning", name, f"has no image in frame {frame.stamp.index}", found=why)
        for name, why in frame.dropped.items()
    )


def _pixels(frame: Frame) -> dict[str, NDArray[np.uint8]]:
    return {name: image.pixels_bgr for name, image in frame.images.items()}


def check_camera_times(frame_ns: Sequence[int], camera_ns: Mapping[str, Sequence[int | None]]) -> tuple[Finding, ...]:
    """Findings about the timestamps of images, at most one a camera.

    frame_ns: F frame timestamps, nanoseconds. camera_ns: by camera, the timestamps of its F images; None without image.
    An offset of 0.1 s is a warning: ego-motion compensates a known offset for static objects, not for moving ones.
    """
    return tuple(filter(None, (_check_times_of(name, frame_ns, times) for name, times in camera_ns.items())))


def _check_times_of(name: str, frame_ns: Sequence[int], times: Sequence[int | None]) -> Finding | None:
    offsets = np.array([time - frame for time, frame in zip(times, frame_ns, strict=True) if time is not None]) / 1e9
    if len(offsets) == 0:
        message = "has no image in any frame"
        return Finding("camera-without-images", "warning", name, message, "0", f"{len(times)}", "check its image paths")
    offset, jitter = float(np.median(offsets)), float(np.std(offsets))
    found = f"{offset * 1e3:+.0f} ms, standard deviation {jitter * 1e3:.0f} ms"
    advice = "give the timestamp of each image, or assign this camera's images to other frames"
    if abs(offset) > OFFSET_ERROR_S:
        message, expected = "its images are far from the frame timestamps", f"within {OFFSET_ERROR_S * 1e3:g} ms"
        return Finding("time-offset", "error", name, message, found, expected, advice)
    if abs(offset) > OFFSET_WARNING_S or jitter > JITTER_WARNING_S:
        message, expected = "its images deviate from the frame timestamps", f"within {OFFSET_WARNING_S * 1e3:g} ms"
        return Finding("time-offset", "warning", name, message, found, expected, advice)
    return None


def _text(check: CalibrationCheck) -> str:
    """The check as plain text, wrapped at 100 columns."""
    rig, coverage = check.rig, check.coverage
    once = 1 - coverage.unseen - coverage.overlap
    seen = f"{coverage.unseen:.1%} of the cells seen by no camera, {once:.1%} by one, {coverage.overlap:.1%} by more"
    parts = [
        f"{check.name}: {counted(len(rig.cameras), 'cameras')}",
        "",
        _cameras(rig, coverage),
        "",
        f"BEV grid: {seen}",
    ]
    parts += ["", *_finding_lines(check.findings)]
    if check.measures:
        rows = [("compared with nuScenes", "this rig", "nuScenes", "")]
        rows += [(m.name, m.value, m.reference, "" if m.is_near else "far") for m in check.measures]
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


def model_notes(rig: CameraRig, model: str) -> list[str]:
    """Paragraphs on where a rig lies outside the training of a model. model: a name, or a FILE.toml."""
    notes = training_rig_notes(rig, load_config(model))
    return [textwrap.fill(f"Model {model}: {note}.", WIDTH, subsequent_indent=INDENT) + "\n" for note in notes]


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
