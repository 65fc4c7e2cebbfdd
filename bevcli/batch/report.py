"""report.html: one page about a batch that needs no other file, for light and dark browsers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np

from bevcli import __version__
from bevcli.batch.charts import bars, histogram
from bevcli.batch.worker import RESULTS, SCORE_BINS, Record
from bevcli.duration import duration
from bevcli.geometry.boxes import CLASSES
from bevcli.pipeline.model_loading import Model

WORST = 10  # drives in the table of the worst ones
MOST_ERRORS = 50  # rows in the table of errors
STYLE = """
:root { color-scheme: light dark; --page: #fcfcfb; --text: #1d1d1b; --soft: #6b6a66; --line: #dddcd6;
  --card: #ffffff; --bar: #2f6db5; --bad: #b3261e; }
@media (prefers-color-scheme: dark) { :root { --page: #171716; --text: #e8e7e3; --soft: #a09f99; --line: #3a3936;
  --card: #20201e; --bar: #6ea8e8; --bad: #f2877f; } }
body { font: 15px/1.5 system-ui, sans-serif; margin: 0 auto; padding: 24px; max-width: 1080px;
  background: var(--page); color: var(--text); }
h1 { font-size: 24px; margin: 0 0 4px; } h2 { font-size: 17px; margin: 32px 0 8px; }
p { margin: 4px 0; } .soft, .none { color: var(--soft); } .bad { color: var(--bad); }
a { color: var(--bar); } code { font-size: 13px; }
.cards { display: grid; grid-template-columns: repeat(auto-fill, minmax(116px, 1fr)); gap: 12px; margin-top: 16px; }
.card { background: var(--card); border: 1px solid var(--line); border-radius: 8px; padding: 10px 14px; }
.card b { display: block; font-size: 22px; font-weight: 600; }
.charts { display: grid; grid-template-columns: repeat(auto-fill, minmax(320px, 1fr)); gap: 16px; }
figure { margin: 0; background: var(--card); border: 1px solid var(--line); border-radius: 8px; padding: 10px; }
figcaption { font-weight: 600; margin-bottom: 4px; }
table.narrow { width: auto; } table.narrow td, table.narrow th { padding-right: 32px; }
svg rect { fill: var(--bar); } svg line { stroke: var(--soft); } svg text { fill: var(--soft); font-size: 11px; }
.scroll { overflow-x: auto; } table { border-collapse: collapse; width: 100%; font-size: 14px; }
th, td { text-align: left; padding: 5px 10px 5px 0; border-bottom: 1px solid var(--line); vertical-align: top; }
td.number, th.number { text-align: right; font-variant-numeric: tabular-nums; }
td:first-child { white-space: nowrap; } img { max-width: 100%; border-radius: 4px; display: block; }
"""
_ERROR_TITLES = {"trans_err": "Translation errors", "orient_err": "Orientation errors", "vel_err": "Velocity errors"}
_ERROR_LABELS = {
    "trans_err": "translation error of a drive, metres",
    "orient_err": "orientation error of a drive, radians",
    "vel_err": "velocity error of a drive, m/s",
}


def page(title: str, body: str) -> str:
    """An HTML page with the style of the reports. body: HTML."""
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{STYLE}</style></head>\n<body>\n{body}\n</body></html>\n"
    )


def write_report(records: Sequence[Record], metrics: dict[str, Any] | None, model: Model) -> str:
    """The page about a batch, as HTML.

    Args:
        records: of the drives that are done or have failed.
        metrics: of `joint_metrics`, None if no drive was scored.
        model: that the drives were run with.
    """
    done = [record for record in records if not record.get("error")]
    failed = [record for record in records if record.get("error")]
    untrained = '<p class="bad">UNTRAINED: random weights, the boxes are meaningless</p>' if model.untrained else ""
    body = [
        f"<h1>Batch of {len(records)} drives</h1>",
        f'<p class="soft">model {escape(model.name)}, bevcli {__version__}</p>{untrained}',
        _cards(done, failed, metrics),
        _distributions(done),
        _classes(done),
        _worst(done),
        _errors(failed),
    ]
    return page(f"Batch of {len(records)} drives", "\n".join(body))


def _cards(done: Sequence[Record], failed: Sequence[Record], metrics: dict[str, Any] | None) -> str:
    frames, seconds = sum(r["frames"] for r in done), sum(r["seconds"] for r in done)
    cards = [("drives done", f"{len(done):,}"), ("drives failed", f"{len(failed):,}"), ("frames", f"{frames:,}")]
    cards += [("boxes", f"{sum(r['boxes'] for r in done):,}"), ("worker time", duration(seconds))]
    cards.append(("frames per second of a worker", f"{frames / seconds:.2f}" if seconds else "-"))
    if metrics is not None:
        present = metrics["classes_with_ground_truth"]
        cards += [(f"mAP, {metrics['drives']:,} drives together", _number(present["mean_ap"]))]
        cards += [(f"NDS, {metrics['drives']:,} drives together", _number(present["nd_score"]))]
    return '<div class="cards">' + "".join(_card(*card) for card in cards) + "</div>"


def _card(name: str, value: str) -> str:
    return f'<div class="card"><b>{escape(value)}</b><span class="soft">{escape(name)}</span></div>'


def _distributions(done: Sequence[Record]) -> str:
    if not done:
        return ""
    scores = np.sum([r["score_histogram"] for r in done], axis=0)
    figures = [
        ("Speed", histogram([r["frames_per_second"] for r in done], "frames per second of a drive")),
        ("Scores", bars(scores.tolist(), np.linspace(0, 1, SCORE_BINS + 1), "score of a box")),
    ]
    scored = [r["scores"] for r in done if r.get("scores")]
    if scored:
        figures.append(("mAP", histogram(_known(scored, "mean_ap"), "mAP of a drive, classes with ground truth")))
        figures += [
            (_ERROR_TITLES[name], histogram(_known(scored, name), label)) for name, label in _ERROR_LABELS.items()
        ]
    charts = "".join(f"<figure><figcaption>{escape(n)}</figcaption>{svg}</figure>" for n, svg in figures)
    return f'<h2>Distributions over drives</h2><div class="charts">{charts}</div>'


def _known(scored: Sequence[dict[str, Any]], name: str) -> list[float]:
    return [scores[name] for scores in scored if scores.get(name) is not None]


def _classes(done: Sequence[Record]) -> str:
    counts: Counter[str] = Counter()
    for record in done:
        counts.update(record["boxes_by_class"])
    names = [*CLASSES, *sorted(counts.keys() - set(CLASSES))]
    rows = [(name, f"{counts[name]:,}") for name in names]
    return f"<h2>Boxes by class</h2>{_table(('class', 'boxes'), rows, numbers=(1,), is_narrow=True)}"


def worst_drives(done: Sequence[Record]) -> tuple[list[Record], str]:
    """The worst drives, the worst first, and what makes a drive bad.

    With ground truth: the lowest mAP. Without any: the most frames with missing images or numbers that are not finite,
    then the lowest mean score.
    """
    scored = [r for r in done if r.get("scores") and r["scores"].get("mean_ap") is not None]
    if scored:
        return sorted(scored, key=lambda r: r["scores"]["mean_ap"])[:WORST], "lowest mAP over classes with ground truth"
    worst = sorted(done, key=lambda r: (-r["dropped_images"] - r["not_finite_frames"], _mean_score(r)))
    return worst[:WORST], "no ground truth: most missing images and NaN frames, then lowest mean score of the boxes"


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
        row = [escape(record["drive"]), *numbers, f"{_mean_score(record):.2f}", str(problems), str(record["frames"])]
        rows.append((*row, f"{link} <code>bevcli viz {escape(path)}</code>"))
    head = ("drive", "mAP", "NDS", "ATE m", "mean score", "missing images, NaN", "frames", "")
    table = _table(head, rows, numbers=range(1, 7), is_html=True)
    return f'<h2>Worst drives</h2><p class="soft">{meaning}</p>{table}'


def _errors(failed: Sequence[Record]) -> str:
    if not failed:
        return "<h2>Errors</h2><p>No drive has failed.</p>"
    rows = [(r["drive"], r["source"], str(r["attempts"]), r["error"]) for r in failed[:MOST_ERRORS]]
    more = len(failed) - MOST_ERRORS
    note = f'<p class="soft">{more:,} more are in batch.csv</p>' if more > 0 else ""
    table = _table(("drive", "input", "attempts", "error"), rows, numbers=(2,))
    return f"<h2>Errors</h2><p>Failed drives: {len(failed):,}</p>{table}{note}"


def _table(
    head: Sequence[str],
    rows: Sequence[Sequence[str]],
    numbers: Sequence[int] = (),
    *,
    is_html: bool = False,
    is_narrow: bool = False,
) -> str:
    """A table.

    numbers: columns with numbers. is_html: whether the cells are HTML already. is_narrow: only as wide as its cells.
    """

    def cell(kind: str, place: int, text: str) -> str:
        return f'<{kind} class="{"number" if place in numbers else "text"}">{text}</{kind}>'

    lines = ["".join(cell("th", place, escape(text)) for place, text in enumerate(head))]
    for row in rows:
        lines.append("".join(cell("td", place, text if is_html else escape(text)) for place, text in enumerate(row)))
    kind = "narrow" if is_narrow else "wide"
    return (
        f'<div class="scroll"><table class="{kind}">' + "".join(f"<tr>{line}</tr>" for line in lines) + "</table></div>"
    )


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
