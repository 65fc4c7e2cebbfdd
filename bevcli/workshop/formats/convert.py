"""`convert`: write any input as a drive of another format."""

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
from bevcli.options import spread
from bevcli.printing import counted
from bevcli.sequences.images import no_image_error
from bevcli.sequences.open import open_sequence
from bevcli.sequences.options import InputOptions
from bevcli.workshop.formats import LabelOptions, WriteOptions
from bevcli.workshop.formats.labels import with_labels
from bevcli.workshop.formats.nuscenes_writer import NuScenesWriter
from bevcli.workshop.formats.output import DriveWriter, NativeWriter

NAMES = {"mcap": "an MCAP file", "native": "a sequence folder", "nuscenes": "a nuScenes root"}


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
    converted: Converted = deque[Any](write_drive(with_labels(drive, labels), Path(out), written), maxlen=1).pop()
    return converted


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
