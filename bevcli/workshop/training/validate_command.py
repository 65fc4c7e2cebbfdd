"""`bevcli validate`: run a model on several drives with ground truth and score them together."""

import json
from typing import Annotated

from bevcli.cli.bridge import Json, Part, model_option, print_note
from bevcli.inference.options import ModelOptions
from bevcli.printing import say
from bevcli.runs.options import RunOptions
from bevcli.workshop.synth.options import DriveOptions
from bevcli.workshop.training.options import ValidationOptions

PANEL = "Score"


def validate(
    model: Annotated[
        str | None,
        model_option("A model name, a FILE.toml or a FILE.onnx. Default: the model that WEIGHTS fit, else demo."),
    ] = None,
    *,
    model_options: Annotated[ModelOptions, Part(only=("weights", "device", "engine", "precision", "calibrate_with"))],
    run_options: Annotated[RunOptions, Part(only=("temporal",))],
    drive_options: DriveOptions,
    options: ValidationOptions,
    as_json: Json = False,
) -> None:
    """Score a model on drives with ground truth, all drives together.

    Each drive is run as by `bevcli run` and scored as by `bevcli eval`, which scores the files of a run that is done.
    `bevcli train` never uses rendered drives with seeds of 1000000 and above: keep them for this.
    """
    from bevcli.cli.progress import Progress
    from bevcli.inference.load import load_model
    from bevcli.workshop.synth.drives import count_frames, scored_drives
    from bevcli.workshop.training.job import rig_for_drives
    from bevcli.workshop.training.validation import check_scored_drives, validate as validate_model

    loaded = load_model(model, options=model_options)
    rig = None if options.rig is None else rig_for_drives(options.rig, model or loaded.name)
    drives = scored_drives(drive_options, loaded.config, rig)
    notes = check_scored_drives(drive_options, drives, loaded.config)
    if loaded.needs_export:
        drive = drives.open(0)
        loaded = loaded.in_engine(drive.rig, drive, report=print_note)
        notes = (*notes, loaded.engine_note) if loaded.engine_note else notes
    runner = loaded.runner(track=options.tracking, temporal=run_options.temporal)
    with Progress(count_frames(drives), "frames", notes) as progress:
        scores = validate_model(
            runner,
            drives,
            options.max_range,
            after_frame=progress.advance,
            each_drive=options.each,
        )
    say(json.dumps(scores.to_dict(), indent=1) if as_json else f"drives  {len(drives)}\n\n{scores.table()}")
