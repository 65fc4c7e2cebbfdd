"""`bevcli export`: write boxes in formats of other tools."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from bevcli.cli.bridge import argument
from bevcli.evaluation.options import ExportOptions
from bevcli.printing import say

if TYPE_CHECKING:
    from bevcli.evaluation.box_format import BoxFormat
    from bevcli.sequences.files.boxes_file import BoxesFile

PANEL = "Score"


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
    from bevcli.registry import load_form
    from bevcli.sequences.files.boxes_file import above_score
    from bevcli.writing import check_output

    chosen: BoxFormat = load_form("bevcli.box_formats", options.form)
    file = predictions / "predictions.json" if predictions.is_dir() else predictions
    target = options.out or file.parent / chosen.target
    check_output(target, file)
    boxes = above_score(_read(file), options.score)
    say(f"{target}: {chosen.write(boxes, target, options, file)}")


def _read(file: Path) -> "BoxesFile":
    """The boxes of a boxes file or of a recording."""
    from bevcli.sequences.files.boxes_file import read_boxes

    if file.suffix.lower() != ".rrd":
        return read_boxes(file)
    from bevcli.viewer.recording_file import open_recording
    from bevcli.viewer.recording_reader import read_recording

    with open_recording(file) as whole:
        if whole != file:
            say(f"note: {file} is incomplete (its run was stopped or is still going)", err=True)
        return read_recording(whole)
