"""`bevcli export`: write boxes in formats of other tools."""

from pathlib import Path
from typing import Annotated

import typer

from bevcli.cli.bridge import INPUT
from bevcli.evaluation.options import ExportOptions
from bevcli.printing import say

PANEL = "Score"
NAMES = {
    "csv": "boxes.csv",
    "kitti": "kitti",
    "nuscenes": "results_nusc.json",
    "nuscenes-tracking": "tracking_nusc.json",
}


def export(
    predictions: Annotated[
        Path, typer.Argument(help="predictions.json, ground_truth.json, or the folder of a run."), INPUT
    ],
    options: ExportOptions,
) -> None:
    """Write boxes as a CSV table, as KITTI labels of one camera, or as a nuScenes submission for detection or tracking.

    KITTI labels are the boxes that one camera sees, in the camera frame. They need --calibration.
    """
    from bevcli.errors import InputError
    from bevcli.evaluation.export import read_kitti_camera, write_csv, write_kitti
    from bevcli.evaluation.submission import write_submission
    from bevcli.sequences.files.boxes_file import above_score, read_boxes
    from bevcli.writing import check_output

    file = predictions / "predictions.json" if predictions.is_dir() else predictions
    boxes, form = above_score(read_boxes(file), options.score), options.form
    target = options.out or file.parent / NAMES[form]
    check_output(target, file)
    if form == "csv":
        say(f"{target}: {write_csv(boxes, target)} boxes")
    elif form in ("nuscenes", "nuscenes-tracking"):
        write_submission(boxes, target, tracking=form == "nuscenes-tracking")
        say(f"{target}: {len(boxes.frames)} samples")
    else:
        if options.calibration is None:
            raise InputError("`form=kitti` needs `calibration`: KITTI labels are in a camera frame")
        chosen, ego_from_bev = read_kitti_camera(options.calibration, options.camera)
        labels = write_kitti(boxes, chosen, ego_from_bev, target)
        say(f"{target}: {len(boxes.frames)} frames, {labels} labels of {chosen.name}")
