"""`convert` and `export`: write any input as a drive of another format, and boxes as a file of another format."""

import importlib.util
import os
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bevcli.errors import BevcliError, InputError, OutputError
from bevcli.frame import Drive, Frame
from bevcli.geometry.boxes import IMPOSSIBLE
from bevcli.options import gather, spread
from bevcli.printing import counted
from bevcli.recording import entities
from bevcli.sequences.files.boxes_file import BoxesFile, BoxesWriter, FrameBoxes, above_score, read_boxes
from bevcli.sequences.files.boxes_table import write_csv
from bevcli.sequences.images import no_image_error
from bevcli.sequences.open import open_sequence
from bevcli.sequences.options import InputOptions
from bevcli.viewer.recording_file import open_recording
from bevcli.viewer.recording_reader import RecordingReader, recorded_boxes
from bevcli.workshop.formats import ExportOptions, LabelOptions, WriteOptions
from bevcli.workshop.formats.kitti import export_kitti
from bevcli.workshop.formats.labels import WithLabels
from bevcli.workshop.formats.nuscenes_output import NuScenesWriter, write_submission
from bevcli.workshop.formats.output import DriveWriter, NativeWriter
from bevcli.writing import check_output, whole_file

NAMES = {"mcap": "an MCAP file", "native": "a sequence folder", "nuscenes": "a nuScenes root"}
# Format -> the name of the file or folder that is written next to the boxes by default.
TARGETS = {
    "csv": "boxes.csv", "json": "boxes.json", "kitti": "kitti", "nuscenes": "results_nusc.json",
    "nuscenes-tracking": "tracking_nusc.json",
}  # fmt: skip


@dataclass(frozen=True)
class Converted:
    """A drive that was written. Its text is one line."""

    out: Path  # the folder or file
    frames: int  # their number
    cameras: int  # their number
    missing: int  # number of images that were missing
    notes: tuple[str, ...]  # what was left out, one line each

    def __str__(self) -> str:
        missing = f", {counted(self.missing, 'images')} missing" if self.missing else ""
        return f"{self.out}: {counted(self.frames, 'frames')}, {counted(self.cameras, 'cameras')}{missing}"


def convert(source: str | Path, out: str | Path, **options: Any) -> Converted:
    """Write any input as a native sequence folder, or as a drive of another format, as `bevcli convert` does.

        bevcli.convert("drive.mcap", "drive", calibration="calibration.json")
        bevcli.convert("samples/street", "street.mcap", form="mcap")

    Args:
        source: an input of `open_sequence`.
        out: the folder or file to write.
        options: those of `WriteOptions` (`form`, `force`, …), of `LabelOptions`, and of `open_sequence`.

    Raises:
        InputError: see `open_sequence`; or not one image could be read.
        OutputError: something is there already, or it cannot be written.
    """
    common, labels, written, format_options = spread(options, InputOptions, LabelOptions, WriteOptions)
    drive = open_sequence(source, to_convert(Path(source), Path(out), common), **format_options)
    converted: Converted = deque[Any](
        write_drive(with_labels(drive, labels, options.get("image_check")), Path(out), written), maxlen=1
    ).pop()
    return converted


def with_labels(drive: Drive, options: LabelOptions, image_check: bool | None) -> Drive:
    """The drive with the boxes of the file of labels, if one is given. Raises InputError as `WithLabels`."""
    return drive if options.labels is None else WithLabels(drive, options.labels, options, image_check is not False)


def to_convert(source: Path, out: Path, options: InputOptions) -> InputOptions:
    """The options of a drive that is written. Raises OutputError where it would be written over its input."""
    if Path(os.path.realpath(source)).is_relative_to(os.path.realpath(out)):
        raise OutputError(f"{out}: contains the input: choose another path")
    return replace(options, ego_motion="optional")


def open_writer(path: Path, drive: Drive, options: WriteOptions) -> DriveWriter:
    """The writer of a path in the format `options.form`.

    Raises InputError for an unknown format, an option of another format or a drive that the format cannot hold, and
    OutputError where the path cannot be written.
    """
    if options.form not in NAMES:
        raise InputError(f"`form={options.form}` (`--format`): unknown format (expected {', '.join(NAMES)})")
    if options.boxes is not None and options.form != "mcap":
        raise InputError(f"`boxes` (`--boxes`): {NAMES[options.form]} takes no boxes of a run: remove the option")
    if path.suffix == ".mcap" and options.form != "mcap":
        raise InputError(f'{path}: would be a folder: pass `form="mcap"` (`--format mcap`), or another name')
    if options.form == "native":
        return NativeWriter(path, with_ego_motion=drive.has_ego_motion, force=options.force, facts=drive.facts)
    if options.form == "nuscenes":
        return NuScenesWriter(path, drive, options)
    if not all(importlib.util.find_spec(name) for name in ("mcap", "rosbags")):
        raise BevcliError('`form="mcap"` (`--format mcap`): needs mcap and rosbags: pip install "bevcli[ros]"')
    from bevcli.workshop.formats.mcap_writer import McapWriter

    return McapWriter(path, drive, options)


def write_drive(drive: Drive, out: Path, options: WriteOptions) -> Iterator[Frame | Converted]:
    """Write a drive, see `convert`: each frame that is written; at the end, what was."""
    missing, images, boxes = 0, 0, 0
    left_out, reasons = set[str](), dict[str, str]()
    with open_writer(out, drive, options) as writer:
        for index in range(len(drive.stamps)):
            frame = drive.load(index)
            missing, reasons = missing + len(frame.dropped), reasons | dict(frame.dropped)
            images, boxes = images + len(frame.images), boxes + frame.impossible_boxes
            writer.write(frame)
            left_out |= truth_left_out(frame, options.form)
            yield frame
        if not images:
            raise no_image_error(drive.name, reasons.items())
    notes = [f"{counted(boxes, 'boxes')} of the ground truth {IMPOSSIBLE}"] if boxes else []
    if left_out:
        name = NAMES[options.form]
        notes.append(f"{name} has no place for {' and '.join(sorted(left_out))} of the ground truth: left out")
    yield Converted(out, len(drive.stamps), len(frame.rig.cameras), missing, tuple(notes))


def truth_left_out(frame: Frame, form: str) -> set[str]:
    """The ground truth of a frame that a format cannot hold, in words: sequence folders keep maps and lines."""
    maps = {"maps": frame.ground_truth_map, "lines of the map": frame.ground_truth_results or None}
    return set() if form == "native" else {name for name, value in maps.items() if value is not None}


def export(predictions: str | Path, options: ExportOptions | None = None, **changes: Any) -> tuple[Path, str]:
    """Write boxes as a table, a boxes file, KITTI labels or a nuScenes submission, as `bevcli export` does.

        bevcli.export("runs/first", form="csv")

    Args:
        predictions: predictions.json, ground_truth.json, the folder of a run, or a recording, whose shown boxes are
            written.
        options: see `ExportOptions`; or as keywords.
        changes: the options as keywords: `form` ("csv", "json", "kitti", "nuscenes", "nuscenes-tracking"), `out`,
            `score`, `calibration` and `camera`.

    Returns the file or folder, and what was written, such as "20 boxes".

    Raises InputError for predictions that cannot be read or that the format cannot hold, and OutputError.
    """
    target, what, _ = export_boxes(Path(predictions), gather(ExportOptions, options, changes))
    return target, what


def export_boxes(predictions: Path, options: ExportOptions) -> tuple[Path, str, str]:
    """Write boxes, see `export`: the file, what was written, and a note where a recording is incomplete, or ""."""
    if options.form not in TARGETS:
        raise InputError(f"`form={options.form}` (`--format`): unknown format (expected {', '.join(TARGETS)})")
    file = predictions / "predictions.json" if predictions.is_dir() else predictions
    target = options.out or file.parent / TARGETS[options.form]
    check_output(target, file)
    boxes, note = _boxes_of(file)
    return target, _write(above_score(boxes, options.score), target, options, file), note


def _boxes_of(file: Path) -> tuple[BoxesFile, str]:
    """The boxes of a boxes file or of a recording, and a note."""
    if file.suffix.lower() != ".rrd":
        return read_boxes(file), ""
    with open_recording(file) as whole:
        note = "" if whole == file else f"{file} is incomplete (its run was stopped or is still going)"
        return read_recording(whole), note


def read_recording(recording: Path) -> BoxesFile:
    """The shown boxes of all frames, in the world frame. Raises InputError for a recording without frames."""
    frames = list[FrameBoxes]()
    for frame in RecordingReader(recording).frames():
        if names := frame.texts(entities.RUN, "layer_names"):
            raise InputError(
                f"{recording}: compares {' and '.join(names)} (expected boxes of one model): use their files"
            )
        frames.append(recorded_boxes(frame))
    if not frames:
        raise InputError(f"{recording}: the recording has no frames with boxes (expected one of `bevcli run`)")
    return BoxesFile("world", tuple(frames))


def _write(boxes: BoxesFile, target: Path, options: ExportOptions, source: Path) -> str:
    """Write boxes of a file, and say what, such as "20 frames, 3 tracks"."""
    if options.form == "kitti":
        return export_kitti(boxes, target, options, source)
    if options.form in ("csv", "json"):
        return counted((write_csv if options.form == "csv" else write_boxes)(boxes, target), "boxes")
    return counted(write_submission(boxes, target, tracking=options.form == "nuscenes-tracking"), "samples")


def write_boxes(boxes: BoxesFile, path: Path) -> int:
    """Write all frames of a file; return the number of boxes. Raises OutputError."""
    facts = boxes.frame_of_reference, boxes.extras, boxes.ego_from_bev
    with whole_file(path) as unfinished, BoxesWriter(unfinished, *facts) as writer:
        for frame in boxes.frames:
            writer.write(frame)
    return sum(len(frame.boxes) for frame in boxes.frames)
