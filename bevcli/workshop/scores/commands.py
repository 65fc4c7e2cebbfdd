"""`bevcli eval`: scores predictions."""

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import bevcli
from bevcli.cli.bridge import FormatValues, Json, Part, argument
from bevcli.cli.progress import open_with_bar
from bevcli.errors import InputError
from bevcli.printing import print_note, say
from bevcli.sequences.format import format_of, is_drive
from bevcli.sequences.options import InputOptions
from bevcli.workshop.scores import EvaluationOptions, ResultOptions
from bevcli.workshop.scores.tables import write_csv, write_latex

if TYPE_CHECKING:
    from bevcli.workshop.trust.agreement import Agreement

PANEL = "Score"


def evaluate(
    predictions: Annotated[
        list[Path],
        argument(
            "predictions.json, the folder of a run, or a results_nusc.json. Two are compared.", metavar="PREDICTIONS"
        ),
    ],
    ground_truth: Annotated[
        Path,
        argument("ground_truth.json, a sequence folder, a nuScenes root, or a drive without labels."),
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

    A drive without ground truth: the boxes are compared with what a detector sees in its images.

    With two files of predictions, A and B: the differences B - A of AP, mAP and NDS with 95 % intervals, and the worst
    frames.
    """
    if options.csv is not None and options.csv == options.latex:
        raise InputError(f"--latex: {options.latex} is the file of --csv too (expected two files): name another")
    scores: Any
    # Of a format that has labels, the reading of them tells.
    unlabelled = is_drive(ground_truth) and not format_of(ground_truth).annotated
    if len(predictions) == 1 and unlabelled and not (ground_truth / "ground_truth.json").exists():
        given = {**vars(options), **vars(results)}
        if refused := [name for name, value in given.items() if value and name not in ("worst", "csv", "latex")]:
            raise InputError(f"--{refused[0].replace('_', '-')}: {ground_truth} has no ground truth: remove it")
        worst = results.worst or 0
        scores = _print_agreement(predictions[0], ground_truth, source, worst, format_options, as_json=as_json)
    elif len(predictions) > 2:
        raise InputError(f"found {len(predictions)} files of predictions (expected 1, or 2 to compare): leave some out")
    else:
        scored: Any = bevcli.evaluate if len(predictions) == 1 else bevcli.compare
        scores = scored(
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
    for path, write in ((options.csv, write_csv), (options.latex, write_latex)):
        if path is not None:
            write(scores.tables(), path)
            say(f"wrote {path}", err=True)
    if options.plot is not None:
        for path in scores.write_plots(options.plot):
            say(f"wrote {path}", err=True)


def _print_agreement(
    predictions: Path,
    path: Path,
    source: InputOptions,
    worst: int,
    format_options: FormatValues,
    *,
    as_json: bool,
) -> "Agreement":
    """Print how well boxes agree with a detector in the images of a drive without ground truth."""
    from bevcli.workshop.trust.estimate import agreement_of_boxes, as_document

    drive = open_with_bar(path, replace(source, ego_motion="optional"), format_options)
    # Not what a run saw, which may be of another part of the drive.
    file = predictions / "predictions.json" if predictions.is_dir() else predictions
    found = agreement_of_boxes(file, drive, source.class_map, worst)
    say(json.dumps(as_document(found, [(drive.name, found)]), indent=1) if as_json else found.table())
    return found
