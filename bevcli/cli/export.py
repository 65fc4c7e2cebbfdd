"""`bevcli export`: write boxes in formats of other tools."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bevcli.cli.bridge import INPUT
from bevcli.evaluation.options import ExportOptions
from bevcli.printing import say

if TYPE_CHECKING:
    from bevcli.sequences.files.boxes_file import BoxesFile

PANEL = "Score"
NAMES = {
    "csv": "boxes.csv",
    "json": "boxes.json",
    "kitti": "kitti",
    "nuscenes": "results_nusc.json",
    "nuscenes-tracking": "tracking_nusc.json",
}


def export(
    predictions: Annotated[
        Path,
        typer.Argument(help="predictions.json, ground_truth.json, the folder of a run, or a recording (.rrd)."),
        INPUT,
    ],
    options: ExportOptions,
) -> None:
    """Write boxes as a table, as a boxes file, as KITTI labels of one camera, or as a nuScenes submission.

    KITTI labels are the boxes that one camera sees, in the camera frame. Of a recording, the shown boxes are written:
    those above the score of the run.
    """
    from bevcli.evaluation.export import kitti_calibration, read_kitti_camera, write_csv, write_kitti
    from bevcli.evaluation.submission import write_submission
    from bevcli.sequences.files.boxes_file import above_score, write_boxes
    from bevcli.writing import check_output

    file = predictions / "predictions.json" if predictions.is_dir() else predictions
    form, target = options.form, options.out or file.parent / NAMES[options.form]
    check_output(target, file)
    boxes = above_score(_read(file), options.score)
    if form in ("csv", "json"):
        count = write_csv(boxes, target) if form == "csv" else write_boxes(boxes, target)
        say(f"{target}: {count} boxes")
    elif form in ("nuscenes", "nuscenes-tracking"):
        write_submission(boxes, target, tracking=form == "nuscenes-tracking")
        say(f"{target}: {len(boxes.frames)} samples")
    else:
        calibration = options.calibration or kitti_calibration(file)
        chosen, ego_from_bev = read_kitti_camera(calibration, options.camera)
        labels = write_kitti(boxes, chosen, ego_from_bev, target)
        say(f"{target}: {len(boxes.frames)} frames, {labels} labels of {chosen.name}")


def _read(file: Path) -> "BoxesFile":
    """The boxes of a boxes file or of a recording."""
    from bevcli.sequences.files.boxes_file import read_boxes

    if file.suffix.lower() != ".rrd":
        return read_boxes(file)
    from bevcli.viewer.export import read_recording
    from bevcli.viewer.recording_file import open_recording

    with open_recording(file) as opened:
        if opened.repaired:
            say(f"note: {file} is incomplete (its run was stopped or is still going)", err=True)
        return read_recording(opened.path)
