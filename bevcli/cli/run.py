"""`bevcli run`: the main job, from a drive to boxes and a recording."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from bevcli.cli.input_options import (
    PANEL,
    ExtrinsicsOption,
    IntrinsicsOption,
    SceneOption,
    SplitOption,
    StrictOption,
    SweepsOption,
    VersionOption,
)

MODEL, OUTPUT, RECORDING = "Model", "Output", "Recording"


def run(
    sequence: Annotated[
        Path, typer.Argument(help="A sequence folder, a folder of videos (one a camera), or a nuScenes root.")
    ],
    model: Annotated[
        str | None,
        typer.Option(
            help="tiny, small, base, demo, or a FILE.toml. Default: what WEIGHTS are for, else demo.",
            rich_help_panel=MODEL,
            show_default=False,
        ),
    ] = None,
    weights: Annotated[
        Path | None,
        typer.Option(
            help="The official .pth as published, or a .safetensors. Default: the package's own, which only demo has.",
            rich_help_panel=MODEL,
            show_default=False,
        ),
    ] = None,
    untrained: Annotated[
        bool, typer.Option("--untrained", help="Run on random weights; everything says so.", rich_help_panel=MODEL)
    ] = False,
    device: Annotated[
        Literal["auto", "cpu", "cuda"], typer.Option(help="auto takes a GPU where there is one.", rich_help_panel=MODEL)
    ] = "auto",
    precision: Annotated[
        Literal["fp32", "bf16", "fp16"] | None,
        typer.Option(help="Default: fp32 on the CPU, bf16 on a GPU.", rich_help_panel=MODEL, show_default=False),
    ] = None,
    temporal: Annotated[
        bool, typer.Option("--temporal/--no-temporal", help="Use the previous BEV map.", rich_help_panel=MODEL)
    ] = True,
    camera: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=MODEL_CAMERA",
            help="Take this camera's embedding for NAME. Repeatable. Default: by name, else by direction.",
            rich_help_panel=MODEL,
        ),
    ] = None,
    frames: Annotated[
        str | None,
        typer.Option(metavar="A:B", help="Only these places in the sequence, B exclusive.", rich_help_panel=PANEL),
    ] = None,
    rate: Annotated[
        str | None,
        typer.Option(metavar="HZ|all", help="Thin to this rate. Default: the model's own.", rich_help_panel=PANEL),
    ] = None,
    every: Annotated[
        int | None, typer.Option(min=1, help="Take every N-th frame, whatever the rate.", rich_help_panel=PANEL)
    ] = None,
    static: Annotated[
        bool, typer.Option("--static", help="The vehicle stands: no ego-motion is needed.", rich_help_panel=PANEL)
    ] = False,
    strict: StrictOption = False,
    scene: SceneOption = None,
    version: VersionOption = None,
    split: SplitOption = None,
    sweeps: SweepsOption = False,
    intrinsics: IntrinsicsOption = None,
    extrinsics: ExtrinsicsOption = None,
    out: Annotated[
        Path | None, typer.Option(help="Default: runs/SEQUENCE-MODEL.", rich_help_panel=OUTPUT, show_default=False)
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Overwrite an existing output folder.", rich_help_panel=OUTPUT)
    ] = False,
    score: Annotated[
        float, typer.Option(min=0, max=1, help="Boxes below are neither shown nor counted.", rich_help_panel=OUTPUT)
    ] = 0.25,
    save_bev: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Write each frame's BEV features as float16 .npy.", rich_help_panel=OUTPUT),
    ] = None,
    live: Annotated[
        bool, typer.Option("--live", help="Open a viewer that follows the run.", rich_help_panel=RECORDING)
    ] = False,
    record: Annotated[
        Literal["minimal", "standard", "full"],
        typer.Option(help="How much goes into the recording.", rich_help_panel=RECORDING),
    ] = "standard",
    bev: Annotated[
        str, typer.Option(help="The BEV features as an image: norm, pca, channel:K, none.", rich_help_panel=RECORDING)
    ] = "pca",
    probe: Annotated[
        list[str] | None,
        typer.Option(
            metavar="X,Y",
            help="Draw where the cell at X, Y (bev frame, m) looks. Repeatable.",
            rich_help_panel=RECORDING,
        ),
    ] = None,
    vehicle_mesh: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Draw the ego vehicle from this mesh (.glb, .ply, .obj, …; metres, origin on the ground under the "
            "rear axle; axes in docs/recording.md). Default: a plain car.",
            rich_help_panel=RECORDING,
            show_default=False,
        ),
    ] = None,
) -> None:
    """Run BEVFormer on SEQUENCE, frame by frame; write boxes and a recording to look at.

    The output folder gets recording.rrd (open it with `bevcli viz`), predictions.json (all boxes, whatever their
    score) and summary.json.
    """
    from bevcli.cli.run_input import FrameChoice, choose_frames, ego_motion_use
    from bevcli.pipeline.model_loading import choose_device, choose_precision, load_model
    from bevcli.pipeline.run_job import Job, run_job
    from bevcli.pipeline.runner import StepOptions
    from bevcli.recording.options import RecordingOptions
    from bevcli.sequences.open import InputOptions

    recording = RecordingOptions(record, bev, score, tuple(map(parse_probe, probe or ())), vehicle_mesh)
    loaded = load_model(model, weights, untrained=untrained)
    motion = ego_motion_use(static=static, temporal=temporal)
    options = InputOptions(motion, strict, scene, version, split, sweeps, intrinsics, extrinsics)
    drive = choose_frames(sequence, options, FrameChoice(frames, rate, every), loaded.model.config)
    target = choose_device(device)
    step = StepOptions(
        choose_precision(precision, target),
        temporal,
        ask_attention=recording.shows_internals,
        probes=recording.probes,
    )
    out = Path("runs") / f"{drive.name}-{loaded.model.config.name}" if out is None else out
    view = None
    if live:
        from bevcli.viewer.live import LiveView

        view = LiveView()
    cameras = dict(map(parse_camera, camera or ()))
    run_job(Job(drive, loaded, target, step, recording, cameras, out, save_bev, view), force=force)


def parse_probe(text: str) -> tuple[float, float]:
    """ "X,Y" -> metres. Raises click's usage error."""
    try:
        x, y = map(float, text.split(","))
    except ValueError:
        raise typer.BadParameter(
            f'"{text}" is no place (expected X,Y in metres, as 10,-2.5)', param_hint="--probe"
        ) from None
    return x, y


def parse_camera(text: str) -> tuple[str, str]:
    """ "NAME=MODEL_CAMERA" -> both names. Raises click's usage error."""
    name, equals, embedding = text.partition("=")
    if not (name and equals and embedding):
        raise typer.BadParameter(f'"{text}" (expected NAME=MODEL_CAMERA)', param_hint="--camera")
    return name, embedding
