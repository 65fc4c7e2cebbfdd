"""`convert`: write any input as a drive of another format."""

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bevcli.errors import InputError, OutputError
from bevcli.frame import Drive, Frame
from bevcli.geometry.boxes import IMPOSSIBLE
from bevcli.options import spread
from bevcli.printing import counted
from bevcli.sequences.images import no_image_error
from bevcli.sequences.open import open_sequence
from bevcli.sequences.options import InputOptions
from bevcli.workshop.formats import LabelOptions, WriteOptions, mcap_writer, nuscenes_writer
from bevcli.workshop.formats.labels import WithLabels
from bevcli.workshop.formats.output import NATIVE, DriveWriter, OutputFormat

DRIVE_FORMATS: dict[str, OutputFormat] = {
    "mcap": mcap_writer.OUTPUT,
    "native": NATIVE,
    "nuscenes": nuscenes_writer.OUTPUT,
}


@dataclass(frozen=True)
class Converted:
    """A drive that was written. Its text is one line.

    Attributes:
        out: the folder or file.
        frames: their number.
        cameras: their number.
        missing: number of images that were missing.
        notes: what was left out, one line each.
    """

    out: Path
    frames: int
    cameras: int
    missing: int
    notes: tuple[str, ...]

    def __str__(self) -> str:
        missing = f", {counted(self.missing, 'images')} missing" if self.missing else ""
        return f"{self.out}: {counted(self.frames, 'frames')}, {counted(self.cameras, 'cameras')}{missing}"


def convert(
    source: str | Path, out: str | Path, *, on_frame: Callable[[Frame], None] = lambda frame: None, **options: Any
) -> Converted:
    """Write any input as a native sequence folder, or as a drive of another format, as `bevcli convert` does.

        bevcli.convert("drive.mcap", "drive", calibration="calibration.json")
        bevcli.convert("samples/street", "street.mcap", form="mcap")

    Args:
        source: an input of `open_sequence`.
        out: the folder or file to write.
        on_frame: called after each frame.
        options: those of `WriteOptions` (`form`, `force`, …), of `LabelOptions`, and of `open_sequence`.

    Raises:
        InputError: see `open_sequence`; or not one image could be read.
        OutputError: something is there already, or it cannot be written.
    """
    common, labels, written, own = spread(options, InputOptions, LabelOptions, WriteOptions)
    sequence = drive_to_convert(Path(source), Path(out), common, labels, own)
    return write_drive(sequence, Path(out), written, on_frame)


def drive_to_convert(source: Path, out: Path, common: InputOptions, labels: LabelOptions, own: dict[str, Any]) -> Drive:
    """The drive that is to be written, with its labels. own: options of its format by name."""
    if Path(os.path.realpath(source)).is_relative_to(os.path.realpath(out)):
        raise OutputError(f"{out}: contains the input: choose another path")
    sequence = open_sequence(source, replace(common, ego_motion="optional"), **own)
    return sequence if labels.labels is None else WithLabels(sequence, labels.labels, labels)


def open_writer(path: Path, sequence: Drive, options: WriteOptions) -> DriveWriter:
    """The writer of a path in the format `options.form`.

    Raises InputError for an unknown format, an option of another format or a drive that the format cannot hold, and
    OutputError where the path cannot be written.
    """
    if options.form not in DRIVE_FORMATS:
        raise InputError(f"`form={options.form}` (`--format`): unknown format (expected {', '.join(DRIVE_FORMATS)})")
    chosen = DRIVE_FORMATS[options.form]
    if options.boxes is not None and not chosen.takes_boxes:
        raise InputError(f"`boxes` (`--boxes`): {chosen.name} takes no boxes of a run: remove the option")
    return chosen.opener(path, sequence, options)


def write_drive(
    sequence: Drive, out: Path, written: WriteOptions, on_frame: Callable[[Frame], None] = lambda frame: None
) -> Converted:
    """Write a drive, see `convert`."""
    gaps, images, boxes = 0, 0, 0
    left_out, reasons = set[str](), dict[str, str]()
    with open_writer(out, sequence, written) as writer:
        form = DRIVE_FORMATS[written.form]
        for place in range(len(sequence.stamps)):
            frame = sequence.load(place)
            gaps, reasons = gaps + len(frame.dropped), reasons | dict(frame.dropped)
            images, boxes = images + len(frame.images), boxes + frame.impossible_boxes
            writer.write(frame)
            left_out |= form.left_out(frame)
            on_frame(frame)
        if not images:
            raise no_image_error(sequence.name, reasons.items())
    notes = [f"{counted(boxes, 'boxes')} of the ground truth {IMPOSSIBLE}"] if boxes else []
    if left_out:
        notes.append(f"{form.name} has no place for {' and '.join(sorted(left_out))} of the ground truth: left out")
    return Converted(out, len(sequence.stamps), len(frame.rig.cameras), gaps, tuple(notes))
