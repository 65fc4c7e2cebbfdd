"""`bevcli convert` and `export`: write drives and boxes in other formats."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import bevcli
from bevcli.cli.bridge import FormatValues, InputDrive, Part, argument
from bevcli.cli.progress import Progress, odometry_bar
from bevcli.printing import print_note, say
from bevcli.sequences.options import InputOptions
from bevcli.workshop.formats import ExportOptions, LabelOptions, WriteOptions

if TYPE_CHECKING:
    from bevcli.frame import Frame

PANEL = {"convert": "Start", "export": "Score"}
CONVERTED = ("strict", "scene", "ground_truth", "allow_outside", "class_map", "odometry")


def convert(
    input: InputDrive,
    out: Annotated[Path, argument("The folder or file to write.", reads=None)],
    options: Annotated[InputOptions, Part(only=CONVERTED)],
    labels: LabelOptions,
    format_options: FormatValues,
    written: WriteOptions,
) -> None:
    """Write any input as a native sequence folder, or as a drive of another format.

    Image files are copied byte for byte; images of a video become PNG. Ego-motion and ground truth are kept.
    Maps and lines of the map go into sequence folders only; a note says where they are left out.
    """
    from bevcli.workshop.formats.convert import drive_to_convert, write_drive

    with odometry_bar() as show_steps:
        reading = replace(options, after_step=show_steps)
        sequence = drive_to_convert(input, out, reading, labels, format_options)

    def show(frame: "Frame") -> None:
        for camera, reason in frame.dropped.items():
            progress.message(f"warning: frame {frame.stamp.index}: camera {camera}: {reason}")
        progress.advance()

    with Progress(len(sequence.stamps), "frames", sequence.notes) as progress:
        converted = write_drive(sequence, out, written, show)
    for note in converted.notes:
        say(f"note: {note}", err=True)
    say(str(converted))


def export(
    predictions: Annotated[
        Path,
        argument("predictions.json, ground_truth.json, the folder of a run, or a recording (.rrd)."),
    ],
    options: ExportOptions,
) -> None:
    """Write boxes as a table, a boxes file, KITTI labels, or a nuScenes submission.

    KITTI labels are the boxes that one camera sees, in the camera frame. Of a recording, the shown boxes are written:
    those above the score of the run.
    """
    target, what = bevcli.export(predictions, options, report=print_note)
    say(f"{target}: {what}")
