"""`bevcli batch`: many drives in, boxes and a recording of each out, with tables and a report."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from bevcli.cli.bridge import FormatValues, Part, argument
from bevcli.inference.options import ModelOptions
from bevcli.printing import say
from bevcli.recording.options import RecordingOptions
from bevcli.runs.options import RunOptions
from bevcli.sequences.options import SequenceOptions
from bevcli.workshop.batch.options import BatchOptions, Workers

if TYPE_CHECKING:
    from bevcli.inference.load import Model
    from bevcli.workshop.batch.job import Drive, Job
    from bevcli.workshop.batch.run_batch import BatchSummary

PANEL = "Run"
SOME_FAILED = 3  # exit code


def batch(
    drives: Annotated[
        list[str] | None,
        argument(
            "Sequence folders, nuScenes roots (one drive per scene), folders of drives such as a DDAD root, "
            ".mcap files, patterns such as 'fleet/*', or URLs such as s3://bucket/fleet/*.",
            "path or pattern",
        ),
    ] = None,
    *,
    options: BatchOptions,
    workers: Workers,
    model: ModelOptions,
    run_options: Annotated[RunOptions, Part(without=("save_bev",))],
    recording: Annotated[RecordingOptions, Part(without=("probes", "vehicle_mesh"))],
    source: Annotated[SequenceOptions, Part(without=("scene",))],
    format_options: Annotated[
        FormatValues,
        Part(without=("intrinsics", "extrinsics", "ego_motion_file")),
    ],
) -> None:
    """Run BEVFormer on many DRIVES, each exactly as `bevcli run` does, on this machine or a Ray cluster.

    The output folder gets drives/NAME-HASH/ with the results of each drive, batch.parquet and batch.csv (one row per
    drive), report.html and, with --eval, metrics.json. A drive that fails after all retries becomes a row with its
    error, and the others go on. Exit code 3: some drives failed. See docs/fleet.md.
    """
    from bevcli.sequences.nuscenes.format import NuScenesOptions
    from bevcli.workshop.batch.job import Job, all_own_options, find_drives, read_list, with_absolute_paths
    from bevcli.workshop.batch.storage import is_url

    texts = [*(drives or ()), *(read_list(options.listed) if options.listed else ())]
    if options.retry_failed and not options.resume:
        raise typer.BadParameter("is for --resume", param_hint="--retry-failed")
    job = Job(
        options.out if is_url(options.out) else str(Path(options.out.removeprefix("file://")).absolute()),
        with_absolute_paths(model),
        run=replace(run_options, recording=recording),
        evaluate=options.evaluate,
        retries=workers.retries,
    )
    loaded = load_for_batch(job, workers, fetch=model.fetch)
    found, notes = find_drives(texts, NuScenesOptions(format_options["version"], format_options.pop("split")))
    if loaded.needs_export:
        notes = (*notes, "the first drive of each number of cameras and image size exports the model, and waits for it")
    source = source.for_model(loaded.config, temporal=run_options.temporal)
    job = replace(job, source=source, own=all_own_options(format_options))
    summary = run_with_progress(
        job, loaded, found, notes, workers, resume=options.resume, retry_failed=options.retry_failed
    )
    say(summary.table())
    if summary.failed:
        say("some drives failed; `--resume --retry-failed` runs them again", err=True)
        raise typer.Exit(SOME_FAILED)


def load_for_batch(job: "Job", workers: Workers, *, fetch: bool = False) -> "Model":
    """The model, loaded before the batch, so that a mistake in it ends the command at once. Raises BevcliError.

    The batch needs its hash; only a worker in this process runs it. fetch: download weights that are missing.
    """
    from bevcli.cli.progress import load_with_bar
    from bevcli.inference.load import choose_device
    from bevcli.workshop.batch.worker import use_threads

    alone, device = workers.in_this_process, job.model.device
    if alone and workers.threads is not None:
        use_threads(workers.threads)
    if alone and workers.gpus == 0 and device == "auto":
        device = "cpu"
    if workers.address is None:
        choose_device(device)
    return load_with_bar(replace(job.model, device=device if alone else "cpu", fetch=fetch))


def run_with_progress(
    job: "Job",
    model: "Model",
    drives: "list[Drive]",
    notes: tuple[str, ...],
    workers: Workers,
    *,
    resume: bool,
    retry_failed: bool = False,
) -> "BatchSummary":
    """Run a batch with its progress on stderr. A stopped one ends the command with the exit code of the signal."""
    from bevcli.cli.progress import Progress
    from bevcli.cli.stop_signals import StopSignals
    from bevcli.workshop.batch.run_batch import run_batch

    alone = workers.in_this_process
    if alone and workers.count is None:
        notes = (*notes, "Ray is not installed: one worker (pip install 'bevcli[ray]' for several)")

    def show(row: dict[str, Any]) -> None:
        if row.get("error"):
            progress.message(f"failed: {row['drive']}: {row['error']}")
        if row.get("input_errors"):
            progress.message(f"warning: {row['drive']}: {row['input_errors']}")
        progress.advance()

    with Progress(len(drives), "drives", notes) as progress, StopSignals("frame", at_once=not alone) as signals:
        summary = run_batch(
            job,
            model,
            drives,
            None if alone else workers,
            resume=resume,
            retry_failed=retry_failed,
            skipped=progress.skip,
            after_drive=show,
            should_stop=signals.received,
        )
    if summary.stopped:
        say(summary.table())
        say("stopped; `--resume` goes on with the drives that are left", err=True)
        raise typer.Exit(signals.exit_code)
    return summary
