"""What `project-debug` looks at: the calibration as far as it can be parsed, and of a sequence what can be opened."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.findings import Finding
from bevcli.frame import Frame, FrameStamp
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.ego_motion import EgoMotion
from bevcli.rig.motion_checks import check_ego_motion
from bevcli.rig.time_checks import check_camera_times
from bevcli.sequences.files.calibration_file import draft_calibration
from bevcli.sequences.native.folder import FolderSequence
from bevcli.sequences.native.frames_table import read_frames_table
from bevcli.sequences.open import open_sequence

CALIBRATION = "calibration.json"


@dataclass(frozen=True)
class DebugInput:
    """rig_findings: from reading the calibration. sequence_findings: about the drive. images: (H, W, 3) BGR."""

    name: str
    rig: CameraRig
    rig_findings: tuple[Finding, ...] = ()
    sequence_findings: tuple[Finding, ...] = ()
    images: Mapping[str, NDArray[np.uint8]] = field(default_factory=dict)


def gather(path: Path, sequence: Path | None, frame: int) -> DebugInput:
    """Read a calibration.json, or a sequence with its own; `sequence` gives images and ego-motion to the first.

    Raises InputError where nothing can be looked at: no such file, no JSON, no such frame.
    """
    if path.is_dir() and not (path / CALIBRATION).exists():
        return _foreign(path, frame)
    file = path / CALIBRATION if path.is_dir() else path
    draft = draft_calibration(file)
    folder = path if path.is_dir() and sequence is None else sequence
    name = (folder or file.with_suffix("")).resolve().name
    if folder is None or not draft.rig.cameras:
        return DebugInput(name, draft.rig, draft.findings)
    findings, images = _look_into(folder, draft.rig, frame)
    return DebugInput(name, draft.rig, draft.findings, findings, images)


def _foreign(path: Path, frame: int) -> DebugInput:
    """A dataset that states its calibration and ego-motion in its own way, and is read as `run` reads it."""
    sequence = open_sequence(path)
    shown = sequence.load(_place(sequence.stamps, frame, path))
    return DebugInput(sequence.name, shown.rig, (), _missing(shown), _pixels(shown))


def _look_into(folder: Path, rig: CameraRig, frame: int) -> tuple[tuple[Finding, ...], Mapping[str, NDArray[np.uint8]]]:
    findings: list[Finding] = []
    try:
        sequence = FolderSequence(folder, rig=rig, ego_motion="optional")
    except InputError as error:
        findings.append(_refused(error))
        try:
            sequence = FolderSequence(folder, rig=rig, ego_motion="static")  # maybe the images can be shown
        except InputError:
            return tuple(findings), {}
    if sequence.ego_motion is not None:
        for part in _scenes(sequence.ego_motion, sequence.stamps):
            findings += check_ego_motion(part)
    if (folder / "frames.csv").is_file():
        findings += _check_times(folder / "frames.csv", rig)
    place = _place(sequence.stamps, frame, folder)
    try:
        shown = sequence.load(place)
    except InputError as error:
        return (*findings, _refused(error)), {}
    return (*findings, *_missing(shown)), _pixels(shown)


def _place(stamps: tuple[FrameStamp, ...], frame: int, path: Path) -> int:
    if not 0 <= frame < len(stamps):
        raise InputError(f"{path}: --frame {frame} is not in the sequence (it has {len(stamps)} frames, from 0)")
    return frame


def _scenes(ego_motion: EgoMotion, stamps: tuple[FrameStamp, ...]) -> Iterator[EgoMotion]:
    """The ego-motion cut midway between frames of different scenes: there the vehicle may be anywhere else."""
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
            )


def _check_times(table: Path, rig: CameraRig) -> tuple[Finding, ...]:
    entries = read_frames_table(table, rig.names)
    times = {
        name: [entry.sources[name].timestamp_ns if name in entry.sources else None for entry in entries]
        for name in rig.names
    }
    return check_camera_times([entry.stamp.timestamp_ns for entry in entries], times)


def _refused(error: InputError) -> Finding:
    advice = "bevcli run refuses this: mend it first"
    return Finding("sequence-refused", "error", None, str(error), advice=advice)


def _missing(frame: Frame) -> tuple[Finding, ...]:
    return tuple(
        Finding("picture-missing", "warning", name, f"has no image in frame {frame.stamp.index}", found=why)
        for name, why in frame.dropped.items()
    )


def _pixels(frame: Frame) -> dict[str, NDArray[np.uint8]]:
    return {name: image.pixels_bgr for name, image in frame.images.items()}
