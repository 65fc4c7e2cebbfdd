"""`bevcli stress`: how a model copes with corrupted images, calibration, times and ego-motion."""

import contextlib
import json
from pathlib import Path
from typing import Annotated

import typer

from bevcli.cli.bridge import FormatValues, Json, Part, argument
from bevcli.cli.progress import Progress, load_with_bar, open_with_bar
from bevcli.cli.stop_signals import StopSignals
from bevcli.errors import InputError
from bevcli.inference import ModelOptions
from bevcli.printing import print_note, say
from bevcli.sequences.options import InputOptions
from bevcli.workshop.robustness import StressOptions, StressOutputOptions
from bevcli.workshop.synth import DriveOptions

PANEL = "Score"


def stress(
    sequence: Annotated[
        list[Path] | None, argument("Sequence folders with ground truth, or a nuScenes root. Or give --rendered SEEDS.")
    ] = None,
    *,
    model: Annotated[ModelOptions, Part(without=("untrained",))],
    options: StressOptions,
    source: Annotated[InputOptions, Part(only=("frames", "scene", "class_map"))],
    format_options: Annotated[FormatValues, Part(only=("version", "split"))],
    drive_options: Annotated[DriveOptions, Part(only=("rendered", "cache"))],
    output: StressOutputOptions,
    as_json: Json = False,
) -> None:
    """Score a model on the same drives under corruptions: RoboBEV's eight, five others, calibration and timing faults.

    Each corruption has three severities (calibration noise: four levels) and is applied on the fly, before the model.
    The table has NDS and mAP by corruption and severity, and mRR, the share of the clean NDS that is left. No training
    of bevcli uses the five others. Ctrl-C or SIGTERM end the test after the current frame; `--resume` goes on with it.
    """
    from bevcli.workshop.robustness import conditions, stress as work

    chosen_conditions = conditions.choose_conditions(output.severity, output.only)
    other = None if options.against is None else work.read_results(options.against)
    if bool(sequence) == (drive_options.rendered is not None):
        raise InputError("choose the drives: give either SEQUENCE folders or --rendered SEEDS, not both")
    loaded, why = load_with_bar(model, sequence or None)
    if drive_options.rendered is None:
        chosen = source.for_model(loaded.config)
        drives = [open_with_bar(path, chosen, format_options) for path in sequence or ()]
    else:
        drives = work.rendered_drives(drive_options, loaded.config, source)
    loaded = loaded.in_engine(drives[0].rig, drives[0])
    out = output.out or Path("runs") / f"stress-{loaded.name}"
    total = len(chosen_conditions) * sum(len(drive.stamps) for drive in drives)
    notes = [*why, *(note for drive in drives for note in drive.notes)]
    test = work.StressTest(loaded, drives, chosen_conditions, out, options, force=output.force, resume=output.resume)
    with (
        Progress(total, "frames", notes) as progress,
        StopSignals("frame") as signals,
        contextlib.closing(test.run()) as frames,
    ):
        if earlier := next(frames):
            progress.skip(earlier)
        for done in frames:
            progress.reach(done)
            if signals.received():
                break
    results = test.results
    if as_json:
        say(json.dumps(results.to_dict(other), indent=1))
    else:
        say(f"drives  {len(drives)}\n\n{work.stress_table(results, other)}")
    for name in () if other is None else results.differences(other):
        print_note(f'"{name}" differs from {options.against}: the corruption errors compare unlike tests')
    if not results.is_complete:
        say("stopped; `--resume` goes on", err=True)
        raise typer.Exit(signals.exit_code)
    say(f"wrote {out}", err=True)
