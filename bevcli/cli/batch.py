"""`bevcli batch`: many drives in, boxes and a recording of each out, with tables and a report."""

from __future__ import annotations

import signal
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any

import typer

from bevcli.cli.input_options import (
    AllowOutsideOption,
    CalibrationOption,
    ClassMapOption,
    EveryOption,
    FramesOption,
    GroundTruthOption,
    RateOption,
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
    parse_rate,
    parse_topics,
)
from bevcli.cli.run_options import (
    MODEL,
    BevOption,
    CameraOption,
    DeviceOption,
    ImagesOption,
    PrecisionOption,
    RecordOption,
    TemporalOption,
    UntrainedOption,
    WeightsOption,
)
from bevcli.cli.stop_signals import StopSignals

if TYPE_CHECKING:
    from bevcli.batch.worker import Record

OUTPUT, WORKERS = "Output", "Workers"
SOME_FAILED = 3  # exit code


def batch(
    out: Annotated[str, typer.Option(help="Folder or URL of the batch.", rich_help_panel=OUTPUT, show_default=False)],
    drives: Annotated[
        list[str] | None,
        typer.Argument(
            help="Sequence folders, nuScenes roots (one drive per scene), .mcap files, patterns such as 'fleet/*', "
            "or URLs such as s3://bucket/fleet/*.",
            show_default=False,
        ),
    ] = None,
    listed: Annotated[
        Path | None,
        typer.Option("--list", metavar="FILE", help="A text file with one drive per line; # starts a comment."),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(
            min=1,
            metavar="N",
            help="Number of workers. Default: one per GPU, else one per core. 1 without --ray needs no Ray.",
            rich_help_panel=WORKERS,
            show_default=False,
        ),
    ] = None,
    ray: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Address of a running Ray cluster, such as auto or 10.0.0.1:6379. Default: Ray on this machine.",
            rich_help_panel=WORKERS,
            show_default=False,
        ),
    ] = None,
    gpus_per_worker: Annotated[
        float | None,
        typer.Option(
            min=0,
            metavar="F",
            help="Share of a GPU of each worker, such as 0.5. Default: 1 if there are GPUs.",
            rich_help_panel=WORKERS,
            show_default=False,
        ),
    ] = None,
    threads: Annotated[
        int | None,
        typer.Option(
            min=1,
            metavar="N",
            help="CPU threads of each worker. Default: cores / workers, 1 on a cluster; without Ray all cores.",
            rich_help_panel=WORKERS,
            show_default=False,
        ),
    ] = None,
    retries: Annotated[
        int,
        typer.Option(min=0, metavar="N", help="Further attempts after a drive has failed.", rich_help_panel=WORKERS),
    ] = 2,
    model: Annotated[
        str | None,
        typer.Option(
            autocompletion=complete_model,
            help="As of `bevcli run`: a model name or a FILE.toml. Default: the model that WEIGHTS fit, else demo.",
            rich_help_panel=MODEL,
            show_default=False,
        ),
    ] = None,
    weights: WeightsOption = None,
    untrained: UntrainedOption = False,
    device: DeviceOption = "auto",
    precision: PrecisionOption = None,
    temporal: TemporalOption = True,
    track: Annotated[
        bool,
        typer.Option(
            "--track/--no-track", help="Give boxes identities over time, and write tracks.csv.", rich_help_panel=MODEL
        ),
    ] = True,
    camera: CameraOption = None,
    frames: FramesOption = None,
    rate: RateOption = None,
    every: EveryOption = None,
    static: StaticOption = False,
    strict: StrictOption = False,
    version: VersionOption = None,
    split: SplitOption = None,
    sweeps: SweepsOption = False,
    calibration: CalibrationOption = None,
    topic: TopicOption = None,
    topics: TopicsOption = None,
    ground_truth: GroundTruthOption = True,
    class_map: ClassMapOption = None,
    allow_outside: AllowOutsideOption = False,
    resume: Annotated[
        bool,
        typer.Option(
            "--resume",
            help="Go on with the batch in the output folder: skip drives that are done or have failed. Drives whose "
            "files, model, weights or options differ run again.",
            rich_help_panel=OUTPUT,
        ),
    ] = False,
    retry_failed: Annotated[
        bool,
        typer.Option("--retry-failed", help="With --resume: run failed drives again.", rich_help_panel=OUTPUT),
    ] = False,
    evaluate: Annotated[
        bool,
        typer.Option(
            "--eval",
            help="Score drives that have ground truth, each and all together (metrics.json).",
            rich_help_panel=OUTPUT,
        ),
    ] = False,
    embed: Annotated[
        bool,
        typer.Option(
            "--embed",
            help="Write a vector per frame, the pooled BEV features, for `bevcli find-like`.",
            rich_help_panel=OUTPUT,
        ),
    ] = False,
    score: Annotated[
        float,
        typer.Option(
            min=0,
            max=1,
            help="Hide and do not count boxes scored below this; predictions.json keeps all of them.",
            rich_help_panel=OUTPUT,
        ),
    ] = 0.25,
    record: RecordOption = "standard",
    images: ImagesOption = "jpeg",
    bev: BevOption = "pca",
) -> None:
    """Run BEVFormer on many DRIVES, each exactly as `bevcli run` does, on this machine or a Ray cluster.

    The output folder gets drives/NAME-HASH/ with the results of each drive, batch.parquet and batch.csv (one row per
    drive), report.html and, with --eval, metrics.json. A drive that fails after all retries becomes a row with its
    error, and the others go on. Exit code 3: some drives failed. See docs/fleet.md.
    """
    from bevcli.batch.drives import find_drives, read_list
    from bevcli.batch.job import Job
    from bevcli.batch.ray_workers import Workers, is_installed
    from bevcli.batch.run_batch import run_batch
    from bevcli.batch.storage import is_url
    from bevcli.batch.worker import use_threads
    from bevcli.cli.progress import Progress
    from bevcli.pipeline.model_loading import choose_device
    from bevcli.pipeline.run import RunOptions
    from bevcli.recording.options import RecordingOptions
    from bevcli.sequences.nuscenes.choice import NuScenesChoice

    texts = [*(drives or ()), *(read_list(listed) if listed else ())]
    if retry_failed and not resume:
        raise typer.BadParameter("is for --resume", param_hint="--retry-failed")
    options = RunOptions(
        temporal,
        track,
        parse_pairs(camera, "--camera", "NAME=MODEL_CAMERA"),
        RecordingOptions(record, bev, score, images=images),
    )
    in_this_process = ray is None and (workers == 1 or (workers is None and not is_installed()))
    if in_this_process and gpus_per_worker == 0 and device == "auto":
        device = "cpu"
    job = Job(
        out if is_url(out) else str(Path(out.removeprefix("file://")).absolute()),
        model,
        None if weights is None else weights.absolute(),
        untrained,
        device,
        precision,
        run=options,
        embed=embed,
        evaluate=evaluate,
        retries=retries,
    )
    if in_this_process and threads is not None:
        use_threads(threads)
    if ray is None:
        choose_device(device)
    # Loaded here, so that a mistake in the model ends the batch at once. Its hash is needed; only one worker runs it.
    loaded = job.load_model(device if in_this_process else "cpu")
    reading: dict[str, Any] = {
        "frames": parse_frames(frames),
        "rate_hz": parse_rate(rate, default_hz=None if every or sweeps else loaded.config.rate_hz),
        "every": every,
        "ego_motion": ego_motion_use(static=static, temporal=temporal),
        "strict": strict,
        "version": version,
        "sweeps": sweeps,
        "calibration": None if calibration is None else calibration.absolute(),
        "topics": parse_topics(topic),
        "topics_file": None if topics is None else topics.absolute(),
        "ground_truth": ground_truth,
        "class_map": parse_class_map(class_map),
        "allow_outside": allow_outside,
    }
    job = replace(job, reading=reading)
    found, notes = find_drives(texts, NuScenesChoice(version, split=split))
    if in_this_process and workers is None:
        notes = (*notes, "Ray is not installed: one worker (pip install 'bevcli[ray]' for several)")

    def show(row: Record) -> None:
        if row.get("error"):
            progress.message(f"failed: {row['drive']}: {row['error']}")
        progress.advance()

    with Progress(len(found), "drives") as progress:
        for note in notes:
            progress.message(f"note: {note}")
        with StopSignals() if in_this_process else _Interrupts() as signals:
            summary = run_batch(
                job,
                loaded,
                found,
                None if in_this_process else Workers(workers, threads, gpus_per_worker, ray),
                resume=resume,
                retry_failed=retry_failed,
                skipped=progress.skip,
                after_drive=show,
                should_stop=signals.received,
            )
    print(summary.table())
    if summary.stopped:
        typer.echo("stopped; `--resume` goes on with the drives that are left", err=True)
        raise typer.Exit(signals.exit_code)
    if summary.failed:
        typer.echo("some drives failed; `--resume --retry-failed` runs them again", err=True)
        raise typer.Exit(SOME_FAILED)


class _Interrupts(StopSignals):
    """Ctrl-C and SIGTERM end a batch whose drives run in other processes at once: by KeyboardInterrupt."""

    def _receive(self, number: int, frame: FrameType | None) -> None:
        self._number = number
        for each in (signal.SIGINT, signal.SIGTERM):
            signal.signal(each, signal.SIG_DFL)
        raise KeyboardInterrupt
