"""`bevcli convert` and `export`: write drives and boxes in other formats."""

from pathlib import Path
from typing import Annotated

from bevcli.cli.bridge import FormatValues, InputDrive, Part, argument
from bevcli.cli.progress import Progress, open_with_bar
from bevcli.printing import print_note, say
from bevcli.sequences.options import InputOptions
from bevcli.workshop.formats import ExportOptions, LabelOptions, WriteOptions

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
    from bevcli.workshop.formats.convert import Converted, to_convert, with_labels, write_drive

    drive = with_labels(
        open_with_bar(input, to_convert(input, out, options), format_options), labels, format_options.get("image_check")
    )
    with Progress(len(drive.stamps), "frames", drive.notes) as progress:
        for step in write_drive(drive, out, written):
            if isinstance(step, Converted):
                break
            for camera, reason in step.dropped.items():
                progress.message(f"warning: frame {step.stamp.index}: camera {camera}: {reason}")
            progress.advance()
    assert isinstance(step, Converted)
    for note in step.notes:
        say(f"note: {note}", err=True)
    say(str(step))


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
    from bevcli.workshop.formats.convert import export_boxes

    target, what, note = export_boxes(predictions, options)
    if note:
        print_note(note)
    say(f"{target}: {what}")
