"""The result of a stress test: scores by condition, resilience rates, corruption errors, stress.json, and the table."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import msgspec

from bevcli.errors import InputError
from bevcli.evaluation.detection import known_mean
from bevcli.evaluation.evaluate import finite
from bevcli.parsing.documents import read_json
from bevcli.printing import aligned
from bevcli.workshop.robustness.conditions import CLEAN, CORRUPTIONS, Corruption, Group

FORMAT = "bevcli-stress/1"


@dataclass(frozen=True)
class ConditionScores:
    """An entry of "conditions" in stress.json: scores over the classes that have ground truth."""

    corruption: str  # name, or "clean"
    severity: str  # "easy", "mid", "hard" or a level; "" for clean
    nd_score: float  # NDS, 0 to 1
    mean_ap: float  # mAP, 0 to 1
    tp_errors: Mapping[str, float | None]  # by the devkit's names; NaN (None of a file) if undefined
    mean_dist_aps: Mapping[str, float]  # class -> AP


@dataclass(frozen=True)
class StressResults:
    """The scores of a model under several conditions.

    Attributes:
        header: what was tested, such as model, weights, drives, seed; for JSON.
        scores: by condition, clean first.
        is_complete: whether all requested conditions were run.
    """

    header: Mapping[str, Any]
    scores: tuple[ConditionScores, ...]
    is_complete: bool = True

    @property
    def clean(self) -> ConditionScores | None:
        """The scores without corruption; None if they are not there yet."""
        return next((scores for scores in self.scores if scores.corruption == CLEAN.name), None)

    def of(self, name: str) -> dict[str, ConditionScores]:
        """Severity -> scores of a corruption, in the order of the severities."""
        return {scores.severity: scores for scores in self.scores if scores.corruption == name}

    def tested(self) -> tuple[Corruption, ...]:
        """The corruptions that have scores, in their order."""
        return tuple(corruption for corruption in CORRUPTIONS if self.of(corruption.name))

    def resilience(self, name: str) -> float:
        """Resilience rate of a corruption: its mean NDS over its severities, over the NDS of clean drives."""
        severities = self.of(name).values()
        if self.clean is None or not severities or not self.clean.nd_score:
            return math.nan
        return sum(scores.nd_score for scores in severities) / len(severities) / self.clean.nd_score

    def corruption_error(self, name: str, against: Self) -> float:
        """Corruption error: the sum of 1 - NDS over the severities that both runs have, over that of the other run."""
        own, other = self.of(name), against.of(name)
        common = [severity for severity in own if severity in other]
        below = sum(1 - other[severity].nd_score for severity in common)
        return sum(1 - own[severity].nd_score for severity in common) / below if below else math.nan

    def mean_resilience(self, group: Group = Group.ROBOBEV) -> float:
        """The mean resilience rate of a group's corruptions that were tested, RoboBEV's mRR; NaN without any."""
        return known_mean(self.resilience(part.name) for part in self.tested() if part.group is group)

    def mean_corruption_error(self, against: Self) -> float:
        """mCE: the mean corruption error of RoboBEV's corruptions that both runs have; NaN without any."""
        return known_mean(
            self.corruption_error(part.name, against) for part in self.tested() if part.group is Group.ROBOBEV
        )

    def to_dict(self, against: Self | None = None) -> dict[str, Any]:
        """All of it for JSON; undefined numbers are None. docs/robustness.md explains the keys."""
        names = [corruption.name for corruption in self.tested()]
        content: dict[str, Any] = {
            "format": FORMAT,
            **self.header,
            "complete": self.is_complete,
            "conditions": [vars(scores) for scores in self.scores],
            "resilience": {name: self.resilience(name) for name in names},
            "mRR": self.mean_resilience(),
            "mean_resilience_unseen": self.mean_resilience(Group.UNSEEN),
        }
        if against is not None:
            content["against"] = {name: against.header.get(name) for name in ("model", "weights")}
            content["corruption_error"] = {name: self.corruption_error(name, against) for name in names}
            content["mCE"] = self.mean_corruption_error(against)
        return finite(content)

    def differences(self, other: Self) -> tuple[str, ...]:
        """Settings other than model and weights that differ between the tests: their scores cannot be compared."""
        names = ("drives", "max_range_m", "seed", "lost_images")
        return tuple(name for name in names if self.header.get(name) != other.header.get(name))


def read_results(path: Path) -> StressResults:
    """Reads a stress.json. Raises InputError where it is missing or wrong."""
    content = read_json(path)
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise InputError(f'{path}: is no result of `bevcli stress` (expected "format": "{FORMAT}")')
    try:
        scores = msgspec.convert(content["conditions"], tuple[ConditionScores, ...])
    except (KeyError, msgspec.ValidationError) as error:
        raise InputError(f'{path}: "conditions" is wrong ({type(error).__name__}: {error})') from None
    return StressResults(content, scores, content.get("complete") is True)


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
    published, unseen = (sum(each.group is group for each in tested) for group in (Group.ROBOBEV, Group.UNSEEN))
    if published:
        parts.append(_means(results, published, against))
    if unseen:
        mean = _percent(results.mean_resilience(Group.UNSEEN))
        parts.append(f"mean resilience {mean} % over {unseen} of 5 corruptions that no training of bevcli uses")
    return "\n\n".join(parts)


def _block(
    results: StressResults, severities: tuple[str, ...], group: list[Corruption], against: StressResults | None
) -> str:
    scale = "level " if severities[0].isdecimal() else ""
    head = [cell for severity in severities for cell in (f"{scale}{severity}: NDS", "mAP")]
    rows = [("corruption", *head, "mean NDS", "RR %", *(("CE %",) if against else ()))]
    for corruption in group:
        scores = results.of(corruption.name)
        cells = []
        for part in map(scores.get, severities):
            cells += [f"{part.nd_score:.3f}", f"{part.mean_ap:.3f}"] if part else ["-", "-"]
        mean = sum(part.nd_score for part in scores.values()) / len(scores)
        rates = [f"{mean:.3f}", _percent(results.resilience(corruption.name))]
        rates += [_percent(results.corruption_error(corruption.name, against))] if against else []
        rows.append((corruption.name, *cells, *rates))
    return aligned(rows)


def _means(results: StressResults, published: int, against: StressResults | None) -> str:
    what = f"over {published} of RoboBEV's 8 corruptions"
    lines = [f"mRR {_percent(results.mean_resilience())} % {what}"]
    if against is not None:
        other = against.header.get("model", "?")
        lines.append(f"mCE {_percent(results.mean_corruption_error(against))} % against {other} {what}")
    return "\n".join(lines)


def _percent(value: float) -> str:
    return "-" if math.isnan(value) else f"{100 * value:.1f}"
