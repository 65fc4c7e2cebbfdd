"""The table and the plot of a stress test."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bevcli.evaluation.plots import titled_figure
from bevcli.evaluation.scores_report import aligned
from bevcli.robustness.conditions import Corruption
from bevcli.robustness.results import ConditionScores, StressResults

SEVERITY_COLORS = ("#b8c9e8", "#7d9fd3", "#3f6fb5", "#173e7a")  # from the easiest severity to the hardest
_OTHER_COLOR = "#d62728"


def stress_table(results: StressResults, against: StressResults | None = None) -> str:
    """NDS and mAP by corruption and severity as text; with `against`, also the corruption errors."""
    parts = []
    if results.clean is not None:
        parts.append(f"clean drives: NDS {results.clean.nd_score:.3f}, mAP {results.clean.mean_ap:.3f}")
    tested = results.tested()
    groups = {
        tuple(corruption.levels): [c for c in tested if c.levels.keys() == corruption.levels.keys()]
        for corruption in tested
    }
    parts += [_block(results, severities, group, against) for severities, group in groups.items()]
    published = sum(corruption.published for corruption in tested)
    if published:
        parts.append(_means(results, published, against))
    return "\n\n".join(parts)


def _block(
    results: StressResults, severities: tuple[str, ...], group: list[Corruption], against: StressResults | None
) -> str:
    """The corruptions with the same severities, a row each."""
    scale = "level " if severities[0].isdecimal() else ""
    head = [cell for severity in severities for cell in (f"{scale}{severity}: NDS", "mAP")]
    rows = [("corruption", *head, "mean NDS", "RR %", *(("CE %",) if against else ()))]
    for corruption in group:
        scores = results.of(corruption.name)
        cells = [cell for severity in severities for cell in _cells(scores.get(severity))]
        mean = sum(found.nd_score for found in scores.values()) / len(scores)
        rates = [f"{mean:.3f}", _percent(results.resilience(corruption.name))]
        rates += [_percent(results.corruption_error(corruption.name, against))] if against else []
        rows.append((corruption.name, *cells, *rates))
    return aligned(rows)


def _cells(scores: ConditionScores | None) -> tuple[str, str]:
    return ("-", "-") if scores is None else (f"{scores.nd_score:.3f}", f"{scores.mean_ap:.3f}")


def _means(results: StressResults, published: int, against: StressResults | None) -> str:
    what = f"over {published} of RoboBEV's 8 corruptions"
    lines = [f"mRR {_percent(results.mean_resilience())} % {what}"]
    if against is not None:
        other = against.header.get("model", "?")
        lines.append(f"mCE {_percent(results.mean_corruption_error(against))} % against {other} {what}")
    return "\n".join(lines)


def _percent(value: float) -> str:
    return "-" if math.isnan(value) else f"{100 * value:.1f}"


def draw_stress(results: StressResults, against: StressResults | None = None) -> Figure:
    """NDS and mAP as bars, one group a corruption, one bar a severity; dashed: clean drives; red: `against`."""
    tested = results.tested()
    other = "" if against is None else f"; red: {against.header.get('model', '?')}, the run compared with"
    figure = titled_figure(
        (max(8.0, 2.5 + 1.2 * len(tested)), 8.5),
        f"Robustness of {results.header.get('model', '?')}",
        f"from the easiest severity (pale) to the hardest; dashed: without corruption{other}",
    )
    panels = figure.subplots(2, 1, sharex=True)
    for axes, label in zip(panels, ("NDS", "mAP"), strict=True):
        _draw_bars(axes, results, label, color=None)
        if against is not None:
            _draw_bars(axes, against, label, color=_OTHER_COLOR, order=tested)
        axes.set_ylabel(label)
        axes.set_ylim(0, 1)
        axes.grid(axis="y", color="#e6e6e6")
        axes.set_axisbelow(True)
    titles = [
        corruption.title.replace(" of the ", "\nof the ").replace(" by up to ", "\nby up to ") for corruption in tested
    ]
    panels[1].set_xticks(range(len(tested)), titles, rotation=35, ha="right")
    return figure


def _draw_bars(
    axes: Axes, results: StressResults, label: str, color: str | None, order: Iterable[Corruption] | None = None
) -> None:
    """Bars, or with a colour only marks at the height of the bars."""
    for place, corruption in enumerate(results.tested() if order is None else order):
        severities = tuple(corruption.levels)
        width = 0.8 / len(severities)
        colors = [SEVERITY_COLORS[i] for i in np.linspace(0, len(SEVERITY_COLORS) - 1, len(severities)).astype(int)]
        for severity, scores in results.of(corruption.name).items():
            index = severities.index(severity)
            x = place - 0.4 + width * (index + 0.5)
            if color is None:
                axes.bar(x, _value(scores, label), 0.92 * width, color=colors[index])
            else:
                axes.hlines(_value(scores, label), x - 0.46 * width, x + 0.46 * width, color=color, linewidth=2)
    if results.clean is not None:
        axes.axhline(_value(results.clean, label), color=color or "black", linewidth=1, linestyle="--")


def _value(scores: ConditionScores, label: str) -> float:
    return scores.nd_score if label == "NDS" else scores.mean_ap
