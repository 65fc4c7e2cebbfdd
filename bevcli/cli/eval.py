"""`bevcli eval`: score predictions against ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from bevcli.cli.input_options import ClassMapOption, SceneOption, SplitOption, VersionOption, parse_class_map


def evaluate(
    predictions: Annotated[Path, typer.Argument(help="predictions.json, the folder of a run, or a results_nusc.json.")],
    ground_truth: Annotated[
        Path,
        typer.Argument(help="ground_truth.json, a sequence folder that contains one, or a nuScenes root."),
    ],
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of the tables.")] = False,
    plot: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Write plots: precision and recall, errors by range, missed objects and false positives from above.",
        ),
    ] = None,
    max_range: Annotated[
        float | None,
        typer.Option(
            metavar="METRES",
            help="Cut nuScenes' class ranges at this distance from the ego vehicle. Default: the model's range.",
            show_default=False,
        ),
    ] = None,
    count_missing: Annotated[
        bool,
        typer.Option("--count-missing", help="Count ground-truth frames without a prediction as missed."),
    ] = False,
    tracking: Annotated[
        bool,
        typer.Option("--tracking", help="Also score tracks: AMOTA, identity switches and the other tracking metrics."),
    ] = False,
    scene: SceneOption = None,
    version: VersionOption = None,
    split: SplitOption = None,
    class_map: ClassMapOption = None,
) -> None:
    """Score PREDICTIONS against GROUND_TRUTH with the nuScenes detection metrics, and maps with IoU if both have them.

    Frames are matched by nuScenes' sample token, else by scene and timestamp, else by frame index.
    """
    import json

    from bevcli.evaluation.evaluate import evaluate

    scores = evaluate(
        predictions,
        ground_truth,
        max_range,
        count_missing,
        tracking=tracking,
        scene=scene,
        version=version,
        split=split,
        class_map=parse_class_map(class_map),
    )
    print(json.dumps(scores.to_dict(), indent=1) if as_json else scores.table())
    for note in scores.notes:
        typer.echo(f"note: {note}", err=True)
    if plot is not None:
        for path in scores.write_plots(plot):
            typer.echo(f"wrote {path}", err=True)
