"""Reads what `check_calibration` checks: a calibration as far as it can be parsed, and data of a sequence."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.findings import Finding
from bevcli.frame import Frame, FrameStamp
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.ego_motion import EgoMotion
from bevcli.rig.sequence_checks import check_camera_times, check_ego_motion
from bevcli.sequences.files.calibration_file import draft_calibration
from bevcli.sequences.native.folder import FolderSequence
from bevcli.sequences.native.frames_table import read_frames_table
from bevcli.sequences.native.ground_truth import GroundTruthUse
from bevcli.sequences.open import open_sequence
from bevcli.sequences.ros.bag import is_ros_bag

CALIBRATION = "calibration.json"


@dataclass(frozen=True)
class CalibrationInputs:
    """What is checked.

    Attributes:
        name: of the calibration file or the sequence.
        rig: the cameras that could be read.
        rig_findings: mistakes in the calibration file itself.
        sequence_findings: mistakes in the sequence's ego-motion, timestamps and images.
        images: by camera, (H, W, 3) uint8 BGR, of one frame; empty without a sequence.
    """

    name: str
    rig: CameraRig
    rig_findings: tuple[Finding, ...] = ()
    sequence_findings: tuple[Finding, ...] = ()
    images: Mapping[str, NDArray[np.uint8]] = field(default_factory=dict)


def read_inputs(
    path: Path, sequence: Path | None, frame: int, options: Mapping[str, Any] | None = None
) -> CalibrationInputs:
    """Read a calibration.json or a sequence with its own calibration.

    options: further arguments of `open_sequence`, for a sequence that is not a native folder.

    sequence: a folder that gives images and ego-motion to a calibration.json elsewhere. frame: index of the frame whose
    images are read. Raises InputError where the file is missing or not a JSON object, or there is no such frame.
    """
    if is_ros_bag(path) or (path.is_dir() and not (path / CALIBRATION).exists()):
        return _read_other_sequence(path, frame, options or {})
    file = path / CALIBRATION if path.is_dir() else path
    draft = draft_calibration(file)
    folder = path if path.is_dir() and sequence is None else sequence
    name = (folder or file.with_suffix("")).resolve().name
    if folder is not None and is_ros_bag(folder):
        return _read_other_sequence(folder, frame, {**(options or {}), "calibration": file})
    if folder is None or not draft.rig.cameras:
        return CalibrationInputs(name, draft.rig, draft.findings)
    findings, images = _read_folder(folder, draft.rig, frame)
    return CalibrationInputs(name, draft.rig, draft.findings, findings, images)


def _read_other_sequence(path: Path, frame: int, options: Mapping[str, Any]) -> CalibrationInputs:
    """A sequence that is not a native folder, such as a nuScenes root or a bag, read as `bevcli run` reads it."""
    sequence = open_sequence(path, ego_motion="optional", ground_truth=False, **options)
    shown = sequence.load(_checked_index(sequence.stamps, frame, path))
    return CalibrationInputs(sequence.name, shown.rig, (), _missing_images(shown), _pixels(shown))


def _read_folder(
    folder: Path, rig: CameraRig, frame: int
) -> tuple[tuple[Finding, ...], Mapping[str, NDArray[np.uint8]]]:
    """The findings about a native folder, and the images of one of its frames."""
    findings: list[Finding] = []
    unread = GroundTruthUse(is_read=False)
    try:
        sequence = FolderSequence(folder, rig=rig, ego_motion="optional", ground_truth=unread)
    except InputError as error:
        findings.append(_refused(error))
        try:
            # Images may be readable without ego-motion.
            sequence = FolderSequence(folder, rig=rig, ego_motion="static", ground_truth=unread)
        except InputError:
            return tuple(findings), {}
    if sequence.ego_motion is not None:
        for part in _split_by_scene(sequence.ego_motion, sequence.stamps):
            findings += check_ego_motion(part)
    if (folder / "frames.csv").is_file():
        findings += _check_times(folder / "frames.csv", rig)
    index = _checked_index(sequence.stamps, frame, folder)
    try:
        shown = sequence.load(index)
    except InputError as error:
        return (*findings, _refused(error)), {}
    return (*findings, *_missing_images(shown)), _pixels(shown)


def _checked_index(stamps: tuple[FrameStamp, ...], frame: int, path: Path) -> int:
    if not 0 <= frame < len(stamps):
        raise InputError(f"{path}: the sequence has no frame {frame} (it has {len(stamps)} frames, counted from 0)")
    return frame


def _split_by_scene(ego_motion: EgoMotion, stamps: tuple[FrameStamp, ...]) -> Iterator[EgoMotion]:
    """The ego-motion of each scene: cut midway between frames of different scenes, where the pose may jump."""
    changes = [(a.timestamp_ns + b.timestamp_ns) // 2 for a, b in pairwise(stamps) if a.scene != b.scene]
    times = ego_motion.timestamps_ns
    rows = np.split(np.arange(len(times)), np.searchsorted(times, np.sort(np.array(changes, dtype=np.int64))))
    for part in rows:
        if len(part) > 1:
            yield EgoMotion(
                times[part],
                ego_motion.translations[part],
                ego_motion.quaternions[part],
                ego_motion.accelerations[part],
                ego_motion.angular_rates[part],
                ego_motion.velocities[part],
                velocities_are_stated=ego_motion.velocities_are_stated,
            )


def _check_times(table: Path, rig: CameraRig) -> tuple[Finding, ...]:
    entries = read_frames_table(table, rig.names)
    times = {
        name: [entry.sources[name].timestamp_ns if name in entry.sources else None for entry in entries]
        for name in rig.names
    }
    return check_camera_times([entry.stamp.timestamp_ns for entry in entries], times)


def _refused(error: InputError) -> Finding:
    advice = "fix this first: bevcli run refuses this sequence"
    return Finding("sequence-refused", "error", None, str(error), advice=advice)


def _missing_images(frame: Frame) -> tuple[Finding, ...]:
    return tuple(
        Finding("picture-missing", "warning", name, f"has no image in frame {frame.stamp.index}", found=why)
        for name, why in frame.dropped.items()
    )


def _pixels(frame: Frame) -> dict[str, NDArray[np.uint8]]:
    return {name: image.pixels_bgr for name, image in frame.images.items()}
