"""The results of a batch: its tables, the scores of all drives together, and report.html.

report.html is one page that needs no other file, for light and dark browsers.
"""

import csv
import io
import json
from collections import Counter
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from html import escape
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from bevcli._version import __version__
from bevcli.frame import MAP_CLASSES
from bevcli.geometry.boxes import Boxes3D, ScoredBoxes
from bevcli.geometry.object_classes import are_nuscenes
from bevcli.inference.load import Model
from bevcli.model.config import ModelConfig
from bevcli.printing import cell_of, counted, duration
from bevcli.runs.state import load_state
from bevcli.workshop.batch.job import Record
from bevcli.workshop.batch.storage import READING_THREADS, RESULTS, Storage
from bevcli.workshop.scores.detection import ERRORS, ClassMatches, DetectionConfig, DetectionScores, with_all_columns
from bevcli.workshop.scores.evaluate import OWN_CLASSES, FrameScores, SegmentationScores

MATCHES = "matches.pt"  # in the folder of a drive's results: for the joint metrics
PARQUET, CSV, METRICS, REPORT = "batch.parquet", "batch.csv", "metrics.json", "report.html"
_COUNTS = ("attempts", "frames", "boxes", "tracks", "dropped_images", "skipped_frames", "not_finite_frames")
WORST = 10  # drives in the table of the worst ones
MOST_ERRORS = 50  # rows in the table of errors
STYLE = """
:root { color-scheme: light dark; --page: #fcfcfb; --text: #1d1d1b; --soft: #6b6a66; --line: #dddcd6;
  --card: #ffffff; --link: #2f6db5; --bad: #b3261e; }
@media (prefers-color-scheme: dark) { :root { --page: #171716; --text: #e8e7e3; --soft: #a09f99; --line: #3a3936;
  --card: #20201e; --link: #6ea8e8; --bad: #f2877f; } }
body { font: 15px/1.5 system-ui, sans-serif; margin: 0 auto; padding: 24px; max-width: 1080px;
  background: var(--page); color: var(--text); }
h1 { font-size: 24px; margin: 0 0 4px; } h2 { font-size: 17px; margin: 32px 0 8px; }
p { margin: 4px 0; } .soft { color: var(--soft); } .bad { color: var(--bad); }
a { color: var(--link); } code { font-size: 13px; }
.cards { display: grid; grid-template-columns: repeat(auto-fill, minmax(116px, 1fr)); gap: 12px; margin-top: 16px; }
.card { background: var(--card); border: 1px solid var(--line); border-radius: 8px; padding: 10px 14px; }
.card b { display: block; font-size: 22px; font-weight: 600; }
table.narrow { width: auto; } table.narrow td, table.narrow th { padding-right: 32px; }
.scroll { overflow-x: auto; } table { border-collapse: collapse; width: 100%; font-size: 14px; }
th, td { text-align: left; padding: 5px 10px 5px 0; border-bottom: 1px solid var(--line); vertical-align: top; }
td.number, th.number { text-align: right; font-variant-numeric: tabular-nums; }
td:first-child { white-space: nowrap; }
"""


def write_results(out: Storage, records: Sequence[Record], model: Model) -> tuple[str, ...]:
    """Write the tables, the joint scores and the report of a batch; return their paths or URLs."""
    metrics = joint_metrics(out, records, model.config)
    classes = model.config.classes
    files = {PARQUET: to_parquet(records, classes), CSV: to_csv(records, classes)}
    if metrics is not None:
        files[METRICS] = (json.dumps(metrics, indent=1) + "\n").encode()
    files[REPORT] = write_report(records, metrics, model).encode()
    for name, content in files.items():
        out.write(name, content)
    return tuple(f"{out.where}/{name}" for name in files)


def columns(classes: Iterable[str]) -> dict[str, pa.DataType]:
    """The columns of the tables and their types. classes: of the model, a column each."""
    return {
        **dict.fromkeys(("drive", "source", "scene", "result", "error"), pa.string()),
        **dict.fromkeys(_COUNTS, pa.int64()),
        **dict.fromkeys(("seconds", "frames_per_second", "fetch_seconds"), pa.float64()),
        "output_bytes": pa.int64(),
        **{f"boxes_{name}": pa.int64() for name in classes},
        **dict.fromkeys(("mean_ap", "nd_score", *ERRORS, *(f"iou_{name}" for name in MAP_CLASSES)), pa.float64()),
        "ground_truth_boxes": pa.int64(),
        **dict.fromkeys(("agreement", "agreement_low", "agreement_high"), pa.float64()),
        **dict.fromkeys(("not_scored", "input_errors"), pa.string()),
    }


def row(record: Record, names: Iterable[str]) -> dict[str, Any]:
    """The columns of a drive; None for what is not known, such as metrics without ground truth."""
    boxes = record.get("boxes_by_class")
    flat = {**(record.get("scores") or {}), **record}
    counts = {} if boxes is None else {name: boxes.get(name.removeprefix("boxes_"), 0) for name in names}
    return {name: counts.get(name) if name.startswith("boxes_") else flat.get(name) for name in names}


def to_parquet(records: Sequence[Record], classes: Iterable[str]) -> bytes:
    """batch.parquet: one row per drive, in the order of the records. classes: of the model."""
    schema = columns(classes)
    table = pa.Table.from_pylist([row(record, schema) for record in records], schema=pa.schema(list(schema.items())))
    buffer = io.BytesIO()
    pq.write_table(table, buffer)
    return buffer.getvalue()


def to_csv(records: Sequence[Record], classes: Iterable[str]) -> bytes:
    """batch.csv: the same columns; an empty field for what is not known."""
    names = columns(classes)
    text = io.StringIO()
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    for record in records:
        cells = row(record, names).items()
        writer.writerow({name: cell_of(cell) if isinstance(cell, str) else cell for name, cell in cells})
    return text.getvalue().encode()


@dataclass(frozen=True)
class DriveMatches:
    """The part of one drive's scores that the joint scores need."""

    frame_count: int  # number of frames that were scored
    matches: tuple[ClassMatches, ...]  # by class, the matching of its boxes
    unmeasured: tuple[str, ...]  # names of errors whose quantity no ground truth of the drive has
    segmentation: SegmentationScores | None  # the scores of its maps, None without maps


def joint_metrics(out: Storage, records: Sequence[Record], model: ModelConfig) -> dict[str, Any] | None:
    """The scores over all frames of all drives with ground truth, with the keys of `bevcli eval --json`, or None.

    Boxes of all drives are scored together: the result is not a mean of the drives' scores. Nothing was scored beyond
    the model's BEV grid. Raises InputError where the matches of a drive cannot be read.
    """
    scored = [record for record in records if record.get("scores")]
    if not scored:
        return None

    def read(record: Record) -> DriveMatches:
        with out.copied(f"{RESULTS}/{record['result']}/{MATCHES}") as path:
            return load_state(path, DriveMatches)

    with ThreadPoolExecutor(READING_THREADS) as pool:
        matches = list(pool.map(read, scored))
    range_m = model.bev_grid.nearest_side_m
    config = DetectionConfig.of(model.object_classes).cut_at(range_m)
    notes = [f"{len(scored)} drives are scored together; nothing beyond {range_m:g} m is scored"]
    if not are_nuscenes(model.object_classes):
        notes.append(OWN_CLASSES)
    return {"drives": len(scored), **replace(score_jointly(matches, config), notes=tuple(notes)).to_dict()}


def score_jointly(drives: Sequence[DriveMatches], config: DetectionConfig) -> FrameScores:
    """The scores over all frames of the drives: AP of all boxes together, not a mean of the drives' scores.

    drives: at least one. config: the parameters with which every drive was matched.
    """
    matches = tuple(_merged([drive.matches[i] for drive in drives]) for i in range(len(config.class_ranges_m)))
    measured = [set(drive.unmeasured) for drive in drives if any(len(part.ground_truth) for part in drive.matches)]
    unmeasured = set.intersection(*measured) if measured else set()
    names = tuple(name for name in ("vel_err", "attr_err") if name in unmeasured)
    detection = DetectionScores(sum(drive.frame_count for drive in drives), matches, names, config)
    maps = [drive.segmentation for drive in drives if drive.segmentation is not None]
    if not maps:
        return FrameScores(detection)
    labels = tuple(dict.fromkeys(label for scores in maps for label in scores.union))
    both, either = (
        {label: sum(of_drive.get(label, 0.0) for of_drive in cells) for label in labels}
        for cells in ([scores.intersection for scores in maps], [scores.union for scores in maps])
    )
    return FrameScores(detection, SegmentationScores(both, either, sum(scores.frame_count for scores in maps)))


def _merged(parts: Sequence[ClassMatches]) -> ClassMatches:
    """The matching of one class in all drives. Equal scores stay in the order of a joint matching."""
    starts = np.cumsum([0, *(len(matches.ground_truth) for matches in parts)])
    moved = [np.where(p.matched < 0, -1, p.matched + start) for p, start in zip(parts, starts, strict=False)]
    # Of equal scores the later one is first, as in `descending_scores`: the last drive comes first.
    predictions = _concatenated([matches.predictions for matches in parts[::-1]])
    order = np.argsort(-predictions.column("scores"), kind="stable")
    return ClassMatches(
        parts[0].name,
        _concatenated([matches.ground_truth for matches in parts]),
        predictions[order],
        np.concatenate(moved[::-1], axis=1)[:, order],
        np.concatenate([matches.truth_counts for matches in parts]),
        np.concatenate([matches.counts for matches in parts[::-1]], axis=1)[:, order],
    )


def _concatenated(parts: Sequence[ScoredBoxes]) -> ScoredBoxes:
    """The boxes of all drives; their frames are not numbered anew."""
    boxes = with_all_columns(Boxes3D.concatenate(scored.boxes for scored in parts))
    frames = np.concatenate([scored.frames for scored in parts])
    return ScoredBoxes(boxes, frames, np.concatenate([scored.ranges_m for scored in parts]))


def write_report(records: Sequence[Record], metrics: dict[str, Any] | None, model: Model) -> str:
    """The page about a batch, as HTML. metrics: of `joint_metrics`, None if no drive was scored."""
    done = [record for record in records if not record.get("error")]
    failed = [record for record in records if record.get("error")]
    untrained = '<p class="bad">UNTRAINED: random weights, the boxes are meaningless</p>' if model.untrained else ""
    title = f"Batch of {counted(len(records), 'drives')}"
    body = [
        f"<h1>{title}</h1>",
        f'<p class="soft">model {escape(model.name)}, bevcli {__version__}</p>{untrained}',
        _cards(done, failed, metrics),
        _classes(done, model.config.classes),
        _worst(done),
        _errors(failed),
    ]
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{title}</title><style>{STYLE}</style></head>\n<body>\n" + "\n".join(body) + "\n</body></html>\n"
    )


def _cards(done: Sequence[Record], failed: Sequence[Record], metrics: dict[str, Any] | None) -> str:
    frames, seconds = sum(r["frames"] for r in done), sum(r["seconds"] for r in done)
    cards = [("drives done", f"{len(done):,}"), ("drives failed", f"{len(failed):,}"), ("frames", f"{frames:,}")]
    cards += [("boxes", f"{sum(r['boxes'] for r in done):,}"), ("worker time", duration(seconds))]
    cards.append(("frames per second of a worker", f"{frames / seconds:.2f}" if seconds else "-"))
    if metrics is not None:
        present = metrics["classes_with_ground_truth"]
        cards += [(f"mAP, {metrics['drives']:,} drives together", _number(present["mean_ap"]))]
        cards += [(f"NDS, {metrics['drives']:,} drives together", _number(present["nd_score"]))]
    shown = [f'<div class="card"><b>{value}</b><span class="soft">{escape(name)}</span></div>' for name, value in cards]
    return f'<div class="cards">{"".join(shown)}</div>'


def _classes(done: Sequence[Record], classes: Sequence[str]) -> str:
    counts: Counter[str] = Counter()
    for record in done:
        counts.update(record["boxes_by_class"])
    names = [*classes, *sorted(counts.keys() - set(classes))]
    rows = [(escape(name), f"{counts[name]:,}") for name in names]
    return f"<h2>Boxes by class</h2>{_table(('class', 'boxes'), rows, (1,), 'narrow')}"


def worst_drives(done: Sequence[Record]) -> tuple[list[Record], str]:
    """The worst drives, the worst first, and the criterion in words."""
    scored = [r for r in done if r.get("scores") and r["scores"].get("mean_ap") is not None]
    if scored:
        return sorted(scored, key=lambda r: r["scores"]["mean_ap"])[:WORST], "lowest mAP over classes with ground truth"
    last, value = "mean score of the boxes", _mean_score
    if all(r.get("agreement") is not None for r in done):
        last, value = "agreement", lambda record: float(record["agreement"])
    worst = sorted(done, key=lambda r: (-r["dropped_images"] - r["not_finite_frames"], value(r)))
    return worst[:WORST], f"no ground truth: most missing images and NaN frames, then lowest {last}"


def _mean_score(record: Record) -> float:
    counts = np.asarray(record["score_histogram"])
    middles = (np.arange(len(counts)) + 0.5) / len(counts)
    return float(counts @ middles / counts.sum()) if counts.sum() else 0.0


def _worst(done: Sequence[Record]) -> str:
    worst, meaning = worst_drives(done)
    if not worst:
        return ""
    rows = []
    for record in worst:
        path = f"{RESULTS}/{record['result']}"
        scores = record.get("scores") or {}
        problems = record["dropped_images"] + record["not_finite_frames"]
        link = f'<a href="{escape(path)}/recording.rrd">recording</a>'
        numbers = [_number(scores.get("mean_ap")), _number(scores.get("nd_score")), _number(scores.get("trans_err"))]
        numbers.append(_number(record.get("agreement")))
        row = [escape(record["drive"]), *numbers, f"{_mean_score(record):.2f}", str(problems), str(record["frames"])]
        rows.append((*row, f"{link} <code>bevcli viz {escape(path)}</code>"))
    head = ("drive", "mAP", "NDS", "ATE m", "agreement", "mean score", "missing images, NaN", "frames", "")
    table = _table(head, rows, range(1, 8))
    return f'<h2>Worst drives</h2><p class="soft">{meaning}</p>{table}'


def _errors(failed: Sequence[Record]) -> str:
    if not failed:
        return "<h2>Errors</h2><p>No drive has failed.</p>"
    rows = [
        tuple(escape(str(record[key])) for key in ("drive", "source", "attempts", "error"))
        for record in failed[:MOST_ERRORS]
    ]
    more = len(failed) - MOST_ERRORS
    note = f'<p class="soft">{more:,} more are in batch.csv</p>' if more > 0 else ""
    table = _table(("drive", "input", "attempts", "error"), rows, (2,))
    return f"<h2>Errors</h2><p>Failed drives: {len(failed):,}</p>{table}{note}"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]], numbers: Sequence[int], style: str = "wide") -> str:
    """A table. rows: cells as HTML. numbers: columns with numbers. style: "narrow" is only as wide as its cells."""
    lines = [("th", [escape(text) for text in head]), *(("td", row) for row in rows)]
    classes = ["number" if column in numbers else "text" for column in range(len(head))]
    body = "".join(
        "<tr>" + "".join(f'<{tag} class="{c}">{text}</{tag}>' for c, text in zip(classes, row, strict=True)) + "</tr>"
        for tag, row in lines
    )
    return f'<div class="scroll"><table class="{style}">{body}</table></div>'


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
