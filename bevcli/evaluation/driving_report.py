"""Scores of lines, forecasts and planned paths as a dict for JSON, and as tables for the terminal."""

import math
from collections.abc import Callable, Iterator
from typing import Any

from bevcli.evaluation.driving import DrivingScores
from bevcli.evaluation.map_lines import THRESHOLDS_M
from bevcli.evaluation.planning import PlanScores
from bevcli.evaluation.scores_report import aligned


def driving_to_dict(scores: DrivingScores) -> dict[str, Any]:
    """The scores as a dict for JSON."""
    content: dict[str, Any] = {}
    if (lines := scores.lines) is not None:
        aps = {name: {f"{limit:.1f}": ap for limit, ap in of_class.items()} for name, of_class in lines.ap.items()}
        content["map"] = {
            "mean_ap": lines.mean_ap,
            "label_aps": aps,
            "mean_dist_aps": lines.mean_by_class,
            "ground_truth_lines": dict(lines.truth_count),
            "frames": lines.frame_count,
        }
    if (motion := scores.motion) is not None:
        content["motion"] = {
            name: {
                "EPA": of_class.epa,
                "minADE": of_class.min_ade,
                "minFDE": of_class.min_fde,
                "MR": of_class.miss_rate,
                "ground_truth": of_class.truths,
            }
            for name, of_class in motion.classes.items()
        }
    if (plan := scores.plan) is not None:
        content["plan"] = {
            "averaged_up_to_horizon": _horizons(plan, plan.averaged, plan.collisions),
            "at_horizon": _horizons(plan, plan.at, plan.collisions_with_vehicles),
            "frames": plan.frame_count,
        }
    return content


def _horizons(plan: PlanScores, of: Callable[[Any, float], float], collisions: Any) -> dict[str, dict[str, float]]:
    """Distances and shares of collisions by horizon, in one convention."""
    seconds = [s for s in (1, 2, 3) if s <= plan.step_s * plan.distances_m.shape[1] + 1e-6]
    return {
        "L2": {f"{s}s": of(plan.distances_m, s) for s in seconds},
        "collision": {f"{s}s": of(collisions, s) for s in seconds},
    }


def driving_tables(scores: DrivingScores) -> Iterator[str]:
    """One table for each kind of scores that was asked for."""
    if (lines := scores.lines) is not None:
        rows = [("map line", "lines", "AP", *(f"AP@{limit:g}m" for limit in THRESHOLDS_M))]
        for name, of_class in lines.ap.items():
            numbers = (lines.mean_by_class[name], *of_class.values())
            rows.append((name, str(lines.truth_count[name]), *map(_number, numbers)))
        yield f"{aligned(rows)}\n\nmap mAP {_number(lines.mean_ap)} ({lines.frame_count} frames)"
    if (motion := scores.motion) is not None:
        rows = [("forecasts", "objects", "EPA", "minADE m", "minFDE m", "miss rate")]
        for name, sums in motion.classes.items():
            numbers = (sums.epa, sums.min_ade, sums.min_fde, sums.miss_rate)
            rows.append((name, str(sums.truths), *map(_number, numbers)))
        yield aligned(rows)
    if (plan := scores.plan) is not None:
        averaged = _horizons(plan, plan.averaged, plan.collisions)
        at = _horizons(plan, plan.at, plan.collisions_with_vehicles)
        rows = [("planned path", *averaged["L2"], "", *averaged["L2"])]
        for name, unit, factor in (("L2", "m", 1), ("collision", "%", 100)):
            cells = [[_number(factor * value) for value in of[name].values()] for of in (averaged, at)]
            rows.append((f"{name} {unit}", *cells[0], "", *cells[1]))
        explained = "left: mean up to the horizon (ST-P3, VAD); right: at the horizon, vehicles only (UniAD)"
        yield f"{aligned(rows)}\n({plan.frame_count} paths; {explained})"


def _number(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.3f}"
