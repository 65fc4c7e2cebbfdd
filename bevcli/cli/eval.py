"""`bevcli eval`: how good are these boxes?"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from bevcli.cli.input_options import SceneOption, SplitOption, VersionOption


def evaluate(
    predictions: Annotated[Path, typer.Argument(help="predictions.json, the folder of a run, or a results_nusc.json.")],
    ground_truth: Annotated[
        Path, typer.Argument(help="ground_truth.json, a sequence folder that has one, or a nuScenes root.")
    ],
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object in place of the tables.")] = False,
    plot: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Write plots: precision and recall, errors by range, misses and false alarms from above.",
        ),
    ] = None,
    max_range: Annotated[
        float | None,
        typer.Option(metavar="METRES", help="Score nothing farther away; nuScenes' class ranges where they are less."),
    ] = None,
    count_missing: Annotated[
        bool,
        typer.Option("--count-missing", help="Ground-truth frames without a prediction count as missed."),
    ] = False,
    scene: SceneOption = None,
    version: VersionOption = None,
    split: SplitOption = None,
) -> None:
    """Score PREDICTIONS against GROUND_TRUTH with the nuScenes detection metrics, and IoU where both have maps.

    Frames are matched by nuScenes' sample token, else by scene and time, else by frame number.
    """
    import json

    from bevcli.evaluation.inputs import open_ground_truth, open_predictions
    from bevcli.evaluation.scores_json import scores_to_json
    from bevcli.evaluation.scores_table import scores_table
    from bevcli.evaluation.scoring import score
    from bevcli.sequences.nuscenes.choice import NuScenesChoice

    truth = open_ground_truth(ground_truth, NuScenesChoice(version, scene, split))
    scores = score(open_predictions(predictions), truth, max_range, count_missing=count_missing)
    if as_json:
        print(json.dumps(scores_to_json(scores.detection, scores.config, scores.segmentation, scores.notes), indent=1))
    else:
        frames = f"{scores.detection.frame_count} frames, matched by {scores.pairs.matched_by}"
        print(f"{frames}\n\n{scores_table(scores.detection, scores.segmentation)}")
    for note in scores.notes:
        typer.echo(f"note: {note}", err=True)
    if plot is not None:
        from bevcli.evaluation.plots import write_plots

        for path in write_plots(scores, plot):
            typer.echo(f"wrote {path}", err=True)
