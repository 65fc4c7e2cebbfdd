"""`bevcli stress`: how a model copes with corrupted images, calibration, times and ego-motion."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from bevcli.cli.input_options import (
    ClassMapOption,
    FramesOption,
    SceneOption,
    SplitOption,
    VersionOption,
    complete_model,
    parse_class_map,
    parse_frames,
)
from bevcli.cli.run_options import MODEL, DeviceOption, EngineOption, PrecisionOption, TemporalOption, WeightsOption

if TYPE_CHECKING:
    from bevcli.frame import Sequence

CONDITIONS, OUTPUT = "Conditions", "Output"


def stress(
    sequence: Annotated[
        list[Path] | None,
        typer.Argument(help="Sequence folders with ground truth, or a nuScenes root. Or give --rendered SEEDS."),
    ] = None,
    model: Annotated[
        str | None,
        typer.Option(
            autocompletion=complete_model,
            help="A model name, a FILE.toml or a FILE.onnx. Default: the model that WEIGHTS fit, else demo.",
            rich_help_panel=MODEL,
            show_default=False,
        ),
    ] = None,
    weights: WeightsOption = None,
    device: DeviceOption = "auto",
    engine: EngineOption = None,
    precision: PrecisionOption = None,
    temporal: TemporalOption = True,
    rendered: Annotated[
        str | None,
        typer.Option(metavar="SEEDS", help="Use rendered drives with these seeds: A:B (B excluded), or A,B,C."),
    ] = None,
    cache: Annotated[Path, typer.Option(metavar="DIR", help="Folder that keeps rendered drives.")] = Path(
        "runs/drives"
    ),
    frames: FramesOption = None,
    scene: SceneOption = None,
    version: VersionOption = None,
    split: SplitOption = None,
    class_map: ClassMapOption = None,
    severity: Annotated[
        Literal["easy", "mid", "hard", "all"],
        typer.Option(
            help="Only this severity. Of the levels of calibration noise, 1 is easy, 2 and 3 are mid, 4 is hard.",
            rich_help_panel=CONDITIONS,
        ),
    ] = "all",
    only: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="Only this corruption: camera_crash, frame_lost, color_quantisation, motion_blur, brightness, "
            "low_light, fog, snow, calibration_noise, time_offset, ego_motion_lost or frame_rate. Repeatable. Clean "
            "drives are always scored.",
            rich_help_panel=CONDITIONS,
        ),
    ] = None,
    lost_images: Annotated[
        Literal["black", "missing"],
        typer.Option(
            help="What the model gets for a lost image: a black image, as in RoboBEV, or none.",
            rich_help_panel=CONDITIONS,
        ),
    ] = "black",
    seed: Annotated[
        int, typer.Option(min=0, help="Seed of all random numbers of the corruptions.", rich_help_panel=CONDITIONS)
    ] = 0,
    max_range: Annotated[
        float | None,
        typer.Option(
            metavar="METRES", help="Ignore boxes beyond this distance. Default: the nearest side of the BEV grid."
        ),
    ] = None,
    against: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="The stress.json of another model on the same drives: adds corruption errors and mCE.",
            rich_help_panel=OUTPUT,
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder for stress.json, stress.png and corruptions.png. Default: runs/stress-MODEL.",
            rich_help_panel=OUTPUT,
            show_default=False,
        ),
    ] = None,
    force: Annotated[
        bool,
        typer.Option(
            "--force", help="Replace the files of an earlier test in the output folder.", rich_help_panel=OUTPUT
        ),
    ] = False,
    resume: Annotated[
        bool,
        typer.Option(
            "--resume",
            help="Go on with a test in the output folder, after its last finished scene. The model, the options and "
            "the drives must be the same; conditions may be added.",
            rich_help_panel=OUTPUT,
        ),
    ] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object instead of the table.", rich_help_panel=OUTPUT)
    ] = False,
) -> None:
    """Score a model on the same drives under corruptions: RoboBEV's eight, calibration noise, and timing faults.

    Each corruption has three severities (calibration noise: four levels) and is applied on the fly, before the model.
    The table has NDS and mAP by corruption and severity, and mRR, the share of the clean NDS that is left. Ctrl-C or
    SIGTERM end the test after the current frame; `--resume` goes on with it.
    """
    import json

    from bevcli.cli.progress import Progress
    from bevcli.cli.stop_signals import StopSignals
    from bevcli.errors import InputError
    from bevcli.pipeline.model_loading import load_model
    from bevcli.robustness.conditions import choose_conditions
    from bevcli.robustness.results import read_results
    from bevcli.robustness.stress import StressOptions, stress
    from bevcli.sequences.open import open_sequence
    from bevcli.sequences.selection import select_range
    from bevcli.training.drives import open_drives, parse_seeds

    conditions = choose_conditions(severity, only or ())
    other = None if against is None else read_results(against)
    if bool(sequence) == (rendered is not None):
        raise InputError("choose the drives: give either SEQUENCE folders or --rendered SEEDS, not both")
    loaded = load_model(model, weights, device=device, precision=precision, engine=engine)
    part = parse_frames(frames)

    def opened() -> list[Sequence]:
        if rendered is None:
            return [
                open_sequence(
                    path,
                    frames=part,
                    rate_hz=loaded.config.rate_hz,
                    scene=scene,
                    version=version,
                    split=split,
                    class_map=parse_class_map(class_map),
                )
                for path in sequence or ()
            ]
        rendered_drives = open_drives((), parse_seeds(rendered), cache, loaded.config)
        drives = [rendered_drives.open(index) for index in range(len(rendered_drives))]
        return drives if part is None else [select_range(drive, part) for drive in drives]

    drives = opened()
    out = Path("runs") / f"stress-{loaded.name}" if out is None else out
    options = StressOptions(seed, lost_images, temporal, max_range)
    total = len(conditions) * sum(len(drive.stamps) for drive in drives)
    with Progress(total, "frames") as progress:
        for note in dict.fromkeys(note for drive in drives for note in drive.notes):
            progress.message(f"note: {note}")
        with StopSignals() as signals:
            results = stress(
                loaded,
                drives,
                conditions,
                out,
                options,
                against=other,
                force=force,
                resume=resume,
                after_frame=progress.advance,
                resumed=progress.skip,
                should_stop=signals.received,
            )
    if as_json:
        print(json.dumps(results.to_dict(other), indent=1))
    else:
        from bevcli.robustness.report import stress_table

        print(f"drives  {len(drives)}\n\n{stress_table(results, other)}")
    for name in () if other is None else results.differences(other):
        typer.echo(f'note: "{name}" differs from {against}: the corruption errors compare unlike tests', err=True)
    if not results.is_complete:
        print("stopped; `--resume` goes on", file=sys.stderr)
        raise typer.Exit(signals.exit_code)
    typer.echo(f"wrote {out}", err=True)
