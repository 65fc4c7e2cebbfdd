"""`bevcli validate`: run a model on several drives with ground truth and score them together."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from bevcli.cli.input_options import complete_model
from bevcli.cli.run_options import DeviceOption, EngineOption, TemporalOption, WeightsOption


def validate(
    model: Annotated[
        str, typer.Argument(autocompletion=complete_model, help="A model name, a FILE.toml or a FILE.onnx.")
    ],
    weights: WeightsOption = None,
    data: Annotated[
        list[Path] | None, typer.Option(metavar="DIR", help="A sequence with ground truth. Repeatable.")
    ] = None,
    rendered: Annotated[
        str | None,
        typer.Option(metavar="SEEDS", help="Use rendered drives with these seeds: A:B (B excluded), or A,B,C."),
    ] = None,
    rig: Annotated[
        str | None,
        typer.Option(
            metavar="FILE|random",
            help="Cameras of the rendered drives: a calibration.json, scaled to the model's image size, or a random "
            "rig for each drive, from training.rigs of the model. Default: six cameras like nuScenes.",
            show_default=False,
        ),
    ] = None,
    cache: Annotated[Path, typer.Option(metavar="DIR", help="Folder that keeps rendered drives.")] = Path(
        "runs/drives"
    ),
    temporal: TemporalOption = True,
    max_range: Annotated[
        float | None,
        typer.Option(
            metavar="METRES", help="Ignore boxes beyond this distance. Default: the nearest side of the BEV grid."
        ),
    ] = None,
    tracking: Annotated[
        bool, typer.Option("--tracking", help="Also run the tracker and score its tracks: AMOTA, identity switches.")
    ] = False,
    each: Annotated[
        bool, typer.Option("--each", help="Also score each drive alone, with the mean and the lowest mAP.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of tables.")] = False,
    device: DeviceOption = "auto",
    engine: EngineOption = None,
) -> None:
    """Score a model on drives with ground truth, all drives together.

    Each drive is run as by `bevcli run` and scored as by `bevcli eval`. `bevcli train` never uses rendered drives with
    seeds of 1000000 and above: keep them for this.
    """
    import json

    from bevcli.cli.progress import Progress
    from bevcli.evaluation.scores_report import scores_table, scores_to_dict
    from bevcli.evaluation.tracking.report import tracking_table, tracking_to_dict
    from bevcli.pipeline.model_loading import load_model
    from bevcli.pipeline.runner import Runner, StepOptions
    from bevcli.training.drives import count_frames, open_drives, parse_seeds
    from bevcli.training.job import rig_for_drives
    from bevcli.training.validation import drives_table
    from bevcli.training.validation import validate as validate_model

    loaded = load_model(model, weights, device=device, engine=engine)
    seeds = None if rendered is None else parse_seeds(rendered)
    drives = open_drives(data or (), seeds, cache, loaded.config, None if rig is None else rig_for_drives(rig, model))
    runner = Runner(loaded.prepared, loaded.device, StepOptions(loaded.precision, temporal))
    with Progress(count_frames(drives), "frames") as progress:
        scores = validate_model(
            runner,
            drives,
            max_range,
            loaded.tracker if tracking else None,
            after_frame=progress.advance,
            each_drive=each,
        )
    if as_json:
        content = scores_to_dict(scores.detection, scores.config, scores.segmentation)
        content |= {} if scores.tracking is None else {"tracking": tracking_to_dict(scores.tracking)}
        content |= {"drives": [drive.to_dict() for drive in scores.drives]} if each else {}
        print(json.dumps(content, indent=1))
    else:
        print(f"drives  {len(drives)}\n\n{scores_table(scores.detection, scores.segmentation)}")
        if scores.tracking is not None:
            print(f"\n{tracking_table(scores.tracking)}")
        if each:
            print(f"\n{drives_table(scores.drives)}")
