"""`bevcli run`: a sequence in, boxes and a recording out."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bevcli.cli.input_options import (
    AllowOutsideOption,
    CalibrationOption,
    ClassMapOption,
    EgoMotionOption,
    EveryOption,
    ExtrinsicsOption,
    FramesOption,
    GroundTruthOption,
    IntrinsicsOption,
    RateOption,
    SceneOption,
    SplitOption,
    StaticOption,
    StrictOption,
    SweepsOption,
    TopicOption,
    TopicsOption,
    VersionOption,
    complete_model,
    ego_motion_use,
    parse_class_map,
    parse_frames,
    parse_pairs,
    parse_position,
    parse_rate,
    parse_topics,
)
from bevcli.cli.run_options import (
    MODEL,
    RECORDING,
    BevOption,
    CameraOption,
    DeviceOption,
    EngineOption,
    ImagesOption,
    PrecisionOption,
    RecordOption,
    TemporalOption,
    UntrainedOption,
    WeightsOption,
)

if TYPE_CHECKING:
    from bevcli.frame import Frame, Prediction, Sequence
    from bevcli.pipeline.model_loading import Model

OUTPUT = "Output"


def run(
    sequence: Annotated[
        Path,
        typer.Argument(help="Sequence folder (images or videos), nuScenes root, .mcap file or rosbag2 folder."),
    ],
    model: Annotated[
        str | None,
        typer.Option(
            autocompletion=complete_model,
            help="tiny, small, base, v2-t1-base, v2-t1, v2-t2, v2-t8, uniad-track-map, demo, a FILE.toml or a "
            "FILE.onnx of `bevcli export-onnx`. Default: the model that WEIGHTS fit, else demo.",
            rich_help_panel=MODEL,
            show_default=False,
        ),
    ] = None,
    weights: WeightsOption = None,
    untrained: UntrainedOption = False,
    device: DeviceOption = "auto",
    engine: EngineOption = None,
    precision: PrecisionOption = None,
    temporal: TemporalOption = True,
    track: Annotated[
        bool,
        typer.Option(
            "--track/--no-track",
            help="Give boxes identities over time, and write tracks.csv. A UniAD with history gives its own.",
            rich_help_panel=MODEL,
        ),
    ] = True,
    camera: CameraOption = None,
    frames: FramesOption = None,
    rate: RateOption = None,
    every: EveryOption = None,
    static: StaticOption = False,
    strict: StrictOption = False,
    scene: SceneOption = None,
    version: VersionOption = None,
    split: SplitOption = None,
    sweeps: SweepsOption = False,
    intrinsics: IntrinsicsOption = None,
    extrinsics: ExtrinsicsOption = None,
    calibration: CalibrationOption = None,
    ego_motion: EgoMotionOption = None,
    topic: TopicOption = None,
    topics: TopicsOption = None,
    ground_truth: GroundTruthOption = True,
    class_map: ClassMapOption = None,
    allow_outside: AllowOutsideOption = False,
    out: Annotated[
        Path | None, typer.Option(help="Default: runs/SEQUENCE-MODEL.", rich_help_panel=OUTPUT, show_default=False)
    ] = None,
    force: Annotated[
        bool,
        typer.Option(
            "--force", help="Replace the files of an earlier run in the output folder.", rich_help_panel=OUTPUT
        ),
    ] = False,
    resume: Annotated[
        bool,
        typer.Option(
            "--resume",
            help="Go on with an interrupted run in the output folder, after its last saved frame. The model, the "
            "options and the input must be the same.",
            rich_help_panel=OUTPUT,
        ),
    ] = False,
    score: Annotated[
        float,
        typer.Option(
            min=0,
            max=1,
            help="Hide boxes scored below this; predictions.json keeps all of them.",
            rich_help_panel=OUTPUT,
        ),
    ] = 0.25,
    save_bev: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Write the BEV features of each frame, as float16 .npy files.", rich_help_panel=OUTPUT
        ),
    ] = None,
    live: Annotated[
        bool,
        typer.Option(
            "--live", help="Open a viewer that shows the recording while it is written.", rich_help_panel=RECORDING
        ),
    ] = False,
    record: RecordOption = "standard",
    images: ImagesOption = "jpeg",
    bev: BevOption = "pca",
    probe: Annotated[
        list[str] | None,
        typer.Option(
            metavar="X,Y",
            help="Show the image points that the BEV cell at X, Y (bev frame, metres) attends to. Repeatable.",
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
    """Run BEVFormer on SEQUENCE, frame by frame, and write boxes and a recording.

    The output folder gets recording.rrd (open it with `bevcli viz`), predictions.json (all boxes of all frames),
    tracks.csv (one row a box with its track), summary.json and, for models that predict a map, segmentation/.
    Ctrl-C or SIGTERM finish the current frame; a second one ends the program at once.
    """
    from bevcli.cli.progress import Progress
    from bevcli.cli.stop_signals import StopSignals
    from bevcli.pipeline.model_loading import load_model
    from bevcli.pipeline.run import RunOptions, run_into_folder
    from bevcli.recording.options import RecordingOptions
    from bevcli.sequences.open import open_sequence

    probes = tuple(parse_position(text, "--probe") for text in probe or ())
    recording = RecordingOptions(record, bev, score, probes, vehicle_mesh, images)
    loaded = load_model(model, weights, device=device, precision=precision, untrained=untrained, engine=engine)
    drive = open_sequence(
        sequence,
        frames=parse_frames(frames),
        rate_hz=parse_rate(rate, default_hz=None if every or sweeps else loaded.config.rate_hz),
        every=every,
        ego_motion=ego_motion_use(static=static, temporal=temporal),
        strict=strict,
        scene=scene,
        version=version,
        split=split,
        sweeps=sweeps,
        intrinsics=intrinsics,
        extrinsics=extrinsics,
        calibration=calibration,
        ego_motion_file=ego_motion,
        topics=parse_topics(topic),
        topics_file=topics,
        ground_truth=ground_truth,
        class_map=parse_class_map(class_map),
        allow_outside=allow_outside,
    )
    out = Path("runs") / f"{drive.name}-{loaded.name}" if out is None else out
    embeddings = parse_pairs(camera, "--camera", "NAME=MODEL_CAMERA")
    options = RunOptions(temporal, track, embeddings, recording, save_bev)

    view = None
    if live:
        from bevcli.viewer.live import LiveView

        view = LiveView()

    def show(frame: Frame, prediction: Prediction) -> None:
        for warning in warnings(frame, prediction):
            progress.message(f"warning: {warning}")
        progress.advance()

    with Progress(len(drive.stamps), "frames") as progress:
        for note in notes(loaded, drive, live=live):
            progress.message(f"note: {note}")
        with StopSignals() as signals:
            summary = run_into_folder(
                loaded,
                drive,
                out,
                options,
                live=view,
                force=force,
                resume=resume,
                after_frame=show,
                resumed=progress.skip,
                should_stop=signals.received,
            )
    print(summary.table())
    if signals.received() and not summary.is_complete:
        print(f"stopped; `--resume` goes on with frame {summary.frames + 1} of {len(drive.stamps)}", file=sys.stderr)
        raise typer.Exit(signals.exit_code)
    print(f"next     bevcli viz {shlex.quote(str(out))}")


def notes(model: Model, drive: Sequence, *, live: bool = False) -> list[str]:
    """What the user should know before the run starts. live: whether a viewer follows the run."""
    from bevcli.model.bevformer_v2 import BEVFormerV2Config

    found = list(drive.notes)
    if model.untrained:
        found.append("the weights are UNTRAINED: random weights, the boxes are meaningless")
    if model.is_exported:
        found.append("an exported file shows no attention: the recording has no history map, pillars and probes")
    if model.left_out:
        found.append(f"{model.weights}: left out {model.left_out}, which only training uses")
    if model.not_read:
        found.append(f"{model.weights}: objects that were not read, and not run: {', '.join(model.not_read)}")
    config = model.config
    if live and isinstance(config, BEVFormerV2Config) and config.later_frames:
        found.append(
            f"model {model.name} looks ahead: the viewer shows a frame when {config.later_frames} more are read"
        )
    found += model.rig_notes(drive.rig)
    if model.bundled:
        found.append("these weights were trained on rendered streets, not on the real world (docs/model-card.md)")
    return found


def warnings(frame: Frame, prediction: Prediction) -> list[str]:
    """What the user should know about a frame; the recording logs its own events."""
    where = f"frame {frame.stamp.index}"
    found = [f"{where}: camera {camera} has no image: {why}" for camera, why in frame.dropped.items()]
    if prediction.skipped:
        found.append(f"{where}: no camera has an image; the state is passed on to the next frame")
    if prediction.not_finite:
        found.append(f"{where}: NaN or infinity in {prediction.not_finite}; no boxes, the history starts anew")
    if prediction.started_anew.startswith("gap"):
        found.append(f"{where}: {prediction.started_anew}; the history starts anew")
    return found
