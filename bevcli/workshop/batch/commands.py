"""`bevcli batch` runs many drives, with tables and a report; `bevcli reproduce` compares scores with published ones."""

import contextlib
import json
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from bevcli.cli.bridge import FormatValues, Json, Part, argument
from bevcli.cli.progress import Progress, load_with_bar
from bevcli.cli.stop_signals import StopSignals
from bevcli.errors import InputError, WeightsError
from bevcli.inference import ModelOptions
from bevcli.printing import say
from bevcli.recording import RecordingOptions
from bevcli.runs import RunOptions
from bevcli.sequences.options import InputOptions
from bevcli.workshop.batch import BatchOptions, ReproduceOptions, Workers
from bevcli.workshop.formats import NuScenesOptions
from bevcli.workshop.weights.commands import fetch_with_bar

if TYPE_CHECKING:
    from bevcli.published import NamedWeights
    from bevcli.workshop.batch.batch import Batch, BatchSummary


PANEL = {"batch": "Run", "reproduce": "Score"}
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
    run_options: Annotated[RunOptions, Part(without=("save_bev", "score_without_labels"))],
    recording: Annotated[RecordingOptions, Part(without=("probes", "vehicle_mesh"))],
    source: Annotated[InputOptions, Part(without=("scene",))],
    format_options: Annotated[FormatValues, Part(without=("intrinsics", "extrinsics", "ego_motion_file"))],
) -> None:
    """Run BEVFormer on many DRIVES, each exactly as `bevcli run` does, on this machine or a Ray cluster.

    The output folder gets drives/NAME-HASH/ with the results of each drive, batch.parquet and batch.csv (one row per
    drive), report.html and, with --eval, metrics.json. A drive that fails after all retries becomes a row with its
    error, and the others go on. Exit code 3: some drives failed. See docs/fleet.md.
    """
    from bevcli.workshop.batch import batch as work

    if options.retry_failed and not options.resume:
        raise typer.BadParameter("is for --resume", param_hint="--retry-failed")
    run_options = replace(run_options, recording=recording)
    job, found, notes = work.job_of(drives or [], options, workers, model, run_options, format_options)
    loaded, _ = load_with_bar(work.options_to_load(job, workers, fetch=model.fetch))
    summary = _run(work.prepare_batch(job, loaded, found, notes, options, workers, source, format_options))
    say(summary.table())
    if summary.failed:
        say("some drives failed; `--resume --retry-failed` runs them again", err=True)
        raise typer.Exit(SOME_FAILED)


def _run(batch: "Batch") -> "BatchSummary":
    """Run a batch with its progress on stderr. A stopped one ends the command with the exit code of the signal."""
    alone, notes = batch.workers.in_this_process, batch.notes
    if alone and batch.workers.count is None:
        notes = (*notes, "Ray is not installed: one worker (pip install 'bevcli[ray]' for several)")
    with (
        Progress(len(batch.drives), "drives", notes) as progress,
        StopSignals("frame", at_once=not alone) as signals,
        contextlib.closing(batch.run()) as running,
    ):
        for record in running:
            if isinstance(record, int):
                progress.skip(record)
            elif record is not None:
                if record.get("error"):
                    progress.message(f"failed: {record['drive']}: {record['error']}")
                if record.get("input_errors"):
                    progress.message(f"warning: {record['drive']}: {record['input_errors']}")
                progress.advance()
            if signals.received():
                break
    if batch.summary.stopped:
        say(batch.summary.table())
        say("stopped; `--resume` goes on with the drives that are left", err=True)
        raise typer.Exit(signals.exit_code)
    return batch.summary


VALIDATION_FRAMES = 6019  # of the nuScenes validation split
# By the name of a score: its key in `FrameScores.to_dict`, and its unit.
SCORES = {
    "NDS": ("nd_score", "%"),
    "mAP": ("mean_ap", "%"),
    "mATE": ("trans_err", "m"),
    "mASE": ("scale_err", ""),
    "mAOE": ("orient_err", "rad"),
    "mAVE": ("vel_err", "m/s"),
    "mAAE": ("attr_err", ""),
}


def reproduce(
    name: Annotated[str, argument("A name of `bevcli weights list`, such as tiny.", reads=None)],
    options: ReproduceOptions,
    workers: Workers,
    model: Annotated[ModelOptions, Part(only=("weights", "fetch", "weights_dir", "device", "precision"))],
    run_options: Annotated[RunOptions, Part(only=("temporal",))],
    as_json: Json = False,
) -> None:
    """Score a published model on a nuScenes split, next to its published scores.

    Every scene of the split is run as `bevcli batch` does, here or on Ray. Missing weights are downloaded after a
    question, or with --fetch. Notes tell what makes the numbers differ. Exit code 3: some scenes failed.
    """
    from bevcli import published
    from bevcli.workshop.batch import batch as work

    named = published.named_weights(name, model.weights_dir)
    split = NuScenesOptions(options.version, options.split)
    drives, notes = work.find_drives([str(options.data)], split)
    if any(drive.scene is None for drive in drives):
        no_root = f"{options.data}: is not a nuScenes root (expected a folder with v1.0-*/scene.json)"
        raise InputError(drives[0].problem or no_root)
    if not (options.data / "can_bus").is_dir():
        notes = (*notes, f"{options.data}: has no folder can_bus, whose values the published models were given")
    if model.weights is None:
        _get(named, model)
    out = options.out or Path("runs") / f"reproduce-{name}-{options.split}"
    job = work.Job(
        str(out.absolute()),
        work.with_absolute_paths(replace(model, model=name)),
        own=work.all_own_options({"version": options.version}),
        run=replace(run_options, track=False, recording=RecordingOptions(level="minimal")),
        evaluate=True,
        retries=workers.retries,
    )
    loaded, _ = load_with_bar(work.options_to_load(job, workers))
    job = replace(job, source=InputOptions().for_model(loaded.config, temporal=run_options.temporal))
    summary = _run(work.Batch(job, loaded, drives, workers, notes, resume=options.resume, retry_failed=options.resume))
    if not any(record.get("scores") for record in summary.records):
        reasons = (record.get("error") or record.get("not_scored") for record in summary.records)
        why = next(filter(None, reasons), "no frames")
        raise InputError(f"{options.data}: no scene could be scored: {why}")
    metrics = json.loads((out / work.METRICS).read_text(encoding="utf-8"))
    comparison = compare_with_published(metrics, named.source.published)
    say(json.dumps(comparison, indent=1) if as_json else table_of(comparison["scores"]))
    for note in comparison["notes"]:
        say(f"note: {note}", err=True)
    if summary.failed:
        say(f"{summary.failed} scenes failed and are not in the scores; `--resume` runs them again", err=True)
        raise typer.Exit(SOME_FAILED)


def _get(named: "NamedWeights", model: ModelOptions) -> None:
    """Download weights that are not there, if --fetch or the user says so. Raises WeightsError."""
    if named.here is not None:
        return
    if named.file is None:
        raise WeightsError(f"{named.name}: {named.by_hand}")
    size = "size unknown" if named.size is None else f"{named.size / 1e6:.1f} MB"
    what = f"the weights {named.name} are not here: {named.source.url or named.source.source} ({size})"
    if not model.fetch and not sys.stdin.isatty():
        raise WeightsError(f"{what}: pass --fetch to download them, or --weights FILE")
    if not model.fetch and not typer.confirm(f"{what}. Download them?", err=True):
        raise WeightsError(f"{named.name}: without its weights nothing can be scored: pass --weights FILE")
    fetch_with_bar(named)


def compare_with_published(metrics: Mapping[str, Any], published: Mapping[str, float]) -> dict[str, Any]:
    """Scores of a split next to the published ones, for JSON.

    Args:
        metrics: of `joint_metrics`; all ten classes count, as in the published scores.
        published: by the names of SCORES; further names cannot be measured here.

    Returns "frames", the number of frames that were scored; "scores", by name: "name", "ours", "published" and
    "difference", each None if not measured or not published; and "notes", why the numbers may differ.
    """
    ours = {**metrics["tp_errors"], **{key: metrics[key] for key in ("nd_score", "mean_ap")}}
    others = [name for name in published if name not in SCORES]
    scores = {name: _pair(name, ours[key], published.get(name)) for name, (key, _) in SCORES.items()}
    scores |= {name: _pair(name, None, published[name]) for name in others}
    notes = []
    if metrics["frames"] != VALIDATION_FRAMES:
        notes.append(
            f"the published scores are those of the {VALIDATION_FRAMES:,} frames of the validation split, these of "
            f"{metrics['frames']:,}: they need not agree"
        )
    if others:
        notes.append(f"{', '.join(others)}: not measured here; `bevcli eval --tracking` scores tracks")
    return {"frames": metrics["frames"], "scores": scores, "notes": notes}


def _pair(name: str, ours: float | None, published: float | None) -> dict[str, Any]:
    difference = None if ours is None or published is None else ours - published
    return {"name": name, "ours": ours, "published": published, "difference": difference}


def table_of(scores: Mapping[str, Mapping[str, Any]]) -> str:
    """The scores of `compare_with_published` as text for a terminal."""
    rows = [f"{'score':9} {'ours':>7} {'published':>10} {'difference':>11}"]
    for name, score in scores.items():
        unit = SCORES[name][1] if name in SCORES else "%"
        ours, published, difference = (
            _number(score[key], unit, sign) for key, sign in (("ours", ""), ("published", ""), ("difference", "+"))
        )
        rows.append(f"{f'{name} {unit}'.strip():9} {ours:>7} {published:>10} {difference:>11}")
    return "\n".join(rows)


def _number(value: float | None, unit: str, sign: str) -> str:
    scale, digits = (100, 1) if unit == "%" else (1, 3)
    return "–" if value is None else f"{scale * value:{sign}.{digits}f}"
