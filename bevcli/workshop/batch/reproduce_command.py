"""`bevcli reproduce`: our scores of a published model next to the published ones."""

import json
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from bevcli.cli.bridge import Json, Part, argument
from bevcli.errors import InputError, WeightsError
from bevcli.inference.options import ModelOptions
from bevcli.printing import say
from bevcli.recording.options import RecordingOptions
from bevcli.runs.options import RunOptions
from bevcli.sequences.nuscenes.format import NuScenesOptions
from bevcli.sequences.options import SequenceOptions
from bevcli.workshop.batch.command import SOME_FAILED, load_for_batch, run_with_progress
from bevcli.workshop.batch.options import ReproduceOptions, Workers

if TYPE_CHECKING:
    from bevcli.published import NamedWeights

PANEL = "Score"
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
    from bevcli.published import named_weights
    from bevcli.workshop.batch.job import Job, all_own_options, find_drives, with_absolute_paths
    from bevcli.workshop.batch.report import METRICS

    named = named_weights(name, model.weights_dir)
    split = NuScenesOptions(options.version, options.split)
    drives, notes = find_drives([str(options.data)], split)
    if any(drive.scene is None for drive in drives):
        no_root = f"{options.data}: is not a nuScenes root (expected a folder with v1.0-*/scene.json)"
        raise InputError(drives[0].problem or no_root)
    if not (options.data / "can_bus").is_dir():
        notes = (*notes, f"{options.data}: has no folder can_bus, whose values the published models were given")
    if model.weights is None:
        _get(named, model)
    out = options.out or Path("runs") / f"reproduce-{name}-{options.split}"
    job = Job(
        str(out.absolute()),
        with_absolute_paths(replace(model, model=name)),
        own=all_own_options({"version": options.version}),
        run=replace(run_options, track=False, recording=RecordingOptions(level="minimal")),
        evaluate=True,
        retries=workers.retries,
    )
    loaded = load_for_batch(job, workers)
    job = replace(job, source=SequenceOptions().for_model(loaded.config, temporal=run_options.temporal))
    summary = run_with_progress(job, loaded, drives, notes, workers, resume=options.resume, retry_failed=options.resume)
    if not any(record.get("scores") for record in summary.records):
        why = next(
            (text for one in summary.records if (text := one.get("error") or one.get("not_scored"))), "no frames"
        )
        raise InputError(f"{options.data}: no scene could be scored: {why}")
    metrics = json.loads((out / METRICS).read_text())
    comparison = compare_with_published(metrics, named.source.published)
    say(json.dumps(comparison, indent=1) if as_json else table_of(comparison["scores"]))
    for note in comparison["notes"]:
        say(f"note: {note}", err=True)
    if summary.failed:
        say(f"{summary.failed} scenes failed and are not in the scores; `--resume` runs them again", err=True)
        raise typer.Exit(SOME_FAILED)


def _get(named: "NamedWeights", model: ModelOptions) -> None:
    """Download weights that are not there, if --fetch or the user says so. Raises WeightsError."""
    from bevcli.cli.progress import fetch_with_bar

    if named.here is not None:
        return
    if named.file is None:
        raise WeightsError(f"{named.name}: {named.by_hand}")
    size = "size unknown" if named.size is None else f"{named.size / 1e6:.1f} MB"
    what = f"the weights {named.name} are not here: {named.source.url or named.source.source} ({size})"
    if not model.fetch and not sys.stdin.isatty():
        raise WeightsError(f"{what}: pass `fetch=True` to download them, or `weights=FILE`")
    if not model.fetch and not typer.confirm(f"{what}. Download them?", err=True):
        raise WeightsError(f"{named.name}: without its weights nothing can be scored: pass `weights=FILE`")
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
