"""`bevcli export`: boxes in the forms that other tools read."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

if TYPE_CHECKING:
    from bevcli.geometry.cameras import Camera
    from bevcli.geometry.transforms import Array


def export(
    predictions: Annotated[Path, typer.Argument(help="predictions.json (or ground truth), or the folder of a run.")],
    form: Annotated[
        Literal["csv", "kitti", "nuscenes"],
        typer.Option("--format", help="csv: one table. kitti: label_2 and calib. nuscenes: results_nusc.json."),
    ],
    out: Annotated[
        Path | None,
        typer.Option(help="Default: boxes.csv, kitti or results_nusc.json beside PREDICTIONS.", show_default=False),
    ] = None,
    score: Annotated[float, typer.Option(min=0, max=1, help="Leave out boxes below.")] = 0.0,
    calibration: Annotated[
        Path | None, typer.Option(help="kitti: calibration.json, or the sequence folder that has it.")
    ] = None,
    camera: Annotated[
        str | None, typer.Option(help="kitti: whose view. Default: CAM_FRONT, else the one that looks ahead most.")
    ] = None,
) -> None:
    """Write boxes as CSV, as KITTI labels of one camera, or as a nuScenes submission.

    KITTI labels are in the camera's frame, of the boxes that it sees, and so need the calibration.
    """
    from bevcli.evaluation.export_csv import write_csv
    from bevcli.evaluation.submission import write_submission
    from bevcli.sequences.files.boxes_file import above_score, read_boxes

    file = predictions / "predictions.json" if predictions.is_dir() else predictions
    boxes = above_score(read_boxes(file), score)
    default_name = {"csv": "boxes.csv", "kitti": "kitti", "nuscenes": "results_nusc.json"}[form]
    target = file.parent / default_name if out is None else out
    if form == "csv":
        typer.echo(f"{target}: {write_csv(boxes, target)} boxes")
    elif form == "nuscenes":
        write_submission(boxes, target)
        typer.echo(f"{target}: {len(boxes.frames)} samples")
    else:
        from bevcli.evaluation.export_kitti import write_kitti

        chosen, ego_from_bev = _calibrated(calibration, camera)
        labels = write_kitti(boxes, chosen, ego_from_bev, target)
        typer.echo(f"{target}: {len(boxes.frames)} frames, {labels} labels of {chosen.name}")


def _calibrated(calibration: Path | None, name: str | None) -> tuple[Camera, Array]:
    """The camera whose view is exported, and ego_from_bev."""
    from bevcli.errors import InputError
    from bevcli.sequences.files.calibration_file import read_calibration

    if calibration is None:
        raise InputError("--format kitti needs --calibration: KITTI labels are in a camera's frame")
    path = calibration / "calibration.json" if calibration.is_dir() else calibration
    rig = read_calibration(path)
    if name is None:
        name = "CAM_FRONT" if "CAM_FRONT" in rig.names else min(rig.cameras, key=lambda camera: abs(camera.yaw)).name
    if name not in rig.names:
        raise InputError(f'{path}: has no camera "{name}" (found: {", ".join(rig.names)})')
    return rig[name], rig.ego_from_bev
