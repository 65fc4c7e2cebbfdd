"""`bevcli eval`: scores predictions."""

import json
from pathlib import Path
from typing import Annotated, Any

import bevcli
from bevcli.cli.bridge import FormatValues, Json, Part, argument
from bevcli.errors import InputError
from bevcli.printing import print_note, say
from bevcli.sequences.options import InputOptions
from bevcli.workshop.scores.options import EvaluationOptions, ResultOptions

PANEL = "Score"


def evaluate(
    predictions: Annotated[
        list[Path],
        argument(
            "predictions.json, the folder of a run, or a results_nusc.json. Two are compared.", metavar="PREDICTIONS"
        ),
    ],
    ground_truth: Annotated[
        Path, argument("ground_truth.json, a sequence folder that contains one, or a nuScenes root.")
    ],
    source: Annotated[InputOptions, Part(only=("scene", "class_map"))],
    format_options: Annotated[FormatValues, Part(only=("version", "split"))],
    options: EvaluationOptions,
    results: ResultOptions,
    as_json: Json = False,
) -> None:
    """Score PREDICTIONS against GROUND_TRUTH with the nuScenes detection metrics, and maps with IoU if both have them.

    Frames are matched by nuScenes' sample token, else by scene and timestamp, else by frame index. `bevcli validate`
    runs a model on several drives and scores them together.

    With two files of predictions, A and B: the differences B - A of AP, mAP and NDS with 95 % intervals, and the worst
    frames.
    """
    if len(predictions) > 2:
        raise InputError(f"found {len(predictions)} files of predictions (expected 1, or 2 to compare): leave some out")
    score: Any = bevcli.evaluate if len(predictions) == 1 else bevcli.compare
    scores = score(
        *predictions,
        ground_truth,
        options.max_range,
        options.count_missing,
        scene=source.scene,
        class_map=source.class_map,
        **format_options,
        **vars(results),
    )
    say(json.dumps(scores.to_dict(), indent=1) if as_json else scores.table())
    for note in scores.notes:
        print_note(note)
    if options.plot is not None:
        for path in scores.write_plots(options.plot):
            say(f"wrote {path}", err=True)
