"""`bevcli convert`: writes any input as a drive of another format."""

import os
from dataclasses import replace
from pathlib import Path
from typing import Annotated

from bevcli.cli.bridge import FormatValues, InputDrive, Part, argument
from bevcli.printing import counted, say
from bevcli.sequences.options import SequenceOptions
from bevcli.workshop.formats import LabelOptions, WriteOptions

PANEL = "Start"


def convert(
    input: InputDrive,
    out: Annotated[Path, argument("The folder or file to write.", reads=None)],
    options: Annotated[SequenceOptions, Part(only=("strict", "scene", "ground_truth", "allow_outside", "class_map"))],
    labels: LabelOptions,
    format_options: FormatValues,
    written: WriteOptions,
) -> None:
    """Write any input as a native sequence folder, or as a drive of another format.

    Image files are copied byte for byte; images of a video become PNG. Ego-motion and ground truth are kept.
    Maps and lines of the map go into sequence folders only; a note says where they are left out.
    """
    from bevcli.cli.progress import Progress
    from bevcli.errors import OutputError
    from bevcli.geometry.boxes import IMPOSSIBLE
    from bevcli.registry import load
    from bevcli.sequences.images import no_image_error
    from bevcli.sequences.open import open_sequence
    from bevcli.workshop.formats.labels import WithLabels
    from bevcli.workshop.formats.output import GROUP, open_writer

    if Path(os.path.realpath(input)).is_relative_to(os.path.realpath(out)):
        raise OutputError(f"{out}: contains the input: choose another path")
    sequence = open_sequence(input, replace(options, ego_motion="optional"), **format_options)
    if labels.labels is not None:
        sequence = WithLabels(sequence, labels.labels, labels)
    count = len(sequence.stamps)
    gaps, left_out = 0, set[str]()
    images, boxes, reasons = 0, 0, dict[str, str]()
    with (
        open_writer(out, sequence, written) as writer,
        Progress(count, "frames", sequence.notes) as progress,
    ):
        for index in range(count):
            frame = sequence.load(index)
            for camera, reason in frame.dropped.items():
                progress.message(f"warning: frame {frame.stamp.index}: camera {camera}: {reason}")
            gaps += len(frame.dropped)
            reasons |= frame.dropped
            images, boxes = images + len(frame.images), boxes + frame.impossible_boxes
            writer.write(frame)
            left_out |= load(GROUP, written.form).left_out(frame)
            progress.advance()
        if not images:
            raise no_image_error(sequence.name, reasons.items())
    if boxes:
        say(f"note: {counted(boxes, 'boxes')} of the ground truth {IMPOSSIBLE}", err=True)
    if left_out:
        name = load(GROUP, written.form).name
        say(f"note: {name} has no place for {' and '.join(sorted(left_out))} of the ground truth: left out", err=True)
    missing = f", {counted(gaps, 'images')} missing" if gaps else ""
    say(f"{out}: {counted(count, 'frames')}, {counted(len(frame.rig.cameras), 'cameras')}{missing}")
