"""`bevcli eval`: score predictions against ground truth."""

import json
from pathlib import Path
from typing import Annotated

from bevcli.cli.bridge import FormatValues, Json, Part, argument, print_note
from bevcli.evaluation.options import EvaluationOptions
from bevcli.evaluation.scorers import score_options
from bevcli.printing import say
from bevcli.sequences.options import SequenceOptions

PANEL = "Score"


def evaluate(
    predictions: Annotated[Path, argument("predictions.json, the folder of a run, or a results_nusc.json.")],
    ground_truth: Annotated[
        Path, argument("ground_truth.json, a sequence folder that contains one, or a nuScenes root.")
    ],
    source: Annotated[SequenceOptions, Part(only=("scene", "class_map"))],
    format_options: Annotated[FormatValues, Part(only=("version", "split"))],
    options: EvaluationOptions,
    results: Annotated[FormatValues, Part(classes=score_options)],
    as_json: Json = False,
) -> None:
    """Score PREDICTIONS against GROUND_TRUTH with the nuScenes detection metrics, and maps with IoU if both have them.

    Frames are matched by nuScenes' sample token, else by scene and timestamp, else by frame index. `bevcli validate`
    runs a model on several drives and scores them together.
    """
    from bevcli.evaluation.evaluate import evaluate

    scores = evaluate(
        predictions,
        ground_truth,
        options.max_range,
        options.count_missing,
        scene=source.scene,
        class_map=source.class_map,
        **format_options,
        **results,
    )
    say(json.dumps(scores.to_dict(), indent=1) if as_json else scores.table())
    for note in scores.notes:
        print_note(note)
    if options.plot is not None:
        for path in scores.write_plots(options.plot):
            say(f"wrote {path}", err=True)
