"""`bevcli export`: write boxes in formats of other tools."""

from pathlib import Path
from typing import Annotated

import typer

from bevcli.cli.bridge import INPUT
from bevcli.evaluation.options import ExportOptions
from bevcli.printing import say

PANEL = "Score"


def export(
    predictions: Annotated[
        Path, typer.Argument(help="predictions.json, ground_truth.json, or the folder of a run."), INPUT
    ],
    options: ExportOptions,
) -> None:
    """Write boxes as a CSV table, KITTI labels, a nuScenes submission, or tracks for annotation tools.

    KITTI labels (kitti) are the boxes that one camera sees, in the camera frame. They need --calibration.
    """
    from bevcli.evaluation.box_format import box_format
    from bevcli.sequences.files.boxes_file import above_score, read_boxes
    from bevcli.writing import check_output

    chosen = box_format(options.form)
    file = predictions / "predictions.json" if predictions.is_dir() else predictions
    boxes = above_score(read_boxes(file), options.score)
    target = options.out or file.parent / chosen.target
    check_output(target, file)
    say(f"{target}: {chosen.write(boxes, target, options)}")
