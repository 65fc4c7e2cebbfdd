"""`bevcli export`: write boxes in formats of other tools."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer


def export(
    predictions: Annotated[Path, typer.Argument(help="predictions.json, ground_truth.json, or the folder of a run.")],
    form: Annotated[
        Literal["csv", "kitti", "nuscenes", "nuscenes-tracking"],
        typer.Option(
            "--format",
            help="csv: one table. kitti: label_2 and calib. nuscenes: results_nusc.json. nuscenes-tracking: "
            "tracking_nusc.json.",
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            help="Default: boxes.csv, kitti, results_nusc.json or tracking_nusc.json next to PREDICTIONS.",
            show_default=False,
        ),
    ] = None,
    score: Annotated[float, typer.Option(min=0, max=1, help="Leave out boxes scored below this.")] = 0.0,
    calibration: Annotated[
        Path | None, typer.Option(help="kitti: calibration.json, or the sequence folder that contains it.")
    ] = None,
    camera: Annotated[
        str | None,
        typer.Option(help="kitti: the camera. Default: CAM_FRONT, else the one that looks most directly ahead."),
    ] = None,
) -> None:
    """Write boxes as a CSV table, as KITTI labels of one camera, or as a nuScenes submission for detection or tracking.

    KITTI labels are the boxes that one camera sees, in the camera frame. They need --calibration.
    """
    from bevcli.errors import InputError
    from bevcli.evaluation.export_csv import write_csv
    from bevcli.evaluation.export_kitti import read_kitti_camera, write_kitti
    from bevcli.evaluation.submission import write_submission
    from bevcli.sequences.files.boxes_file import above_score, read_boxes

    file = predictions / "predictions.json" if predictions.is_dir() else predictions
    boxes = above_score(read_boxes(file), score)
    default_names = {
        "csv": "boxes.csv",
        "kitti": "kitti",
        "nuscenes": "results_nusc.json",
        "nuscenes-tracking": "tracking_nusc.json",
    }
    target = file.parent / default_names[form] if out is None else out
    if form == "csv":
        typer.echo(f"{target}: {write_csv(boxes, target)} boxes")
    elif form in ("nuscenes", "nuscenes-tracking"):
        write_submission(boxes, target, tracking=form == "nuscenes-tracking")
        typer.echo(f"{target}: {len(boxes.frames)} samples")
    else:
        if calibration is None:
            raise InputError("--format kitti needs --calibration: KITTI labels are in a camera frame")
        chosen, ego_from_bev = read_kitti_camera(calibration, camera)
        labels = write_kitti(boxes, chosen, ego_from_bev, target)
        typer.echo(f"{target}: {len(boxes.frames)} frames, {labels} labels of {chosen.name}")
