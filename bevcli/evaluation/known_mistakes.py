"""Patterns of scores that a known mistake makes, so that a user need not search for it."""

from collections.abc import Mapping, Sequence
from statistics import fmean
from typing import Any

# A class with less is found by chance, and its errors say nothing.
SMALLEST_AP = 0.05
# With length and width exchanged, a car of 4.6 x 1.9 m has an IoU of 0.26 with itself, and its heading is off by 90
# degrees. Public evaluations with this mistake have mASE 0.71 to 0.75 and mAOE 1.3 to 1.6 (issues 24 and 140 of
# BEVFormer, 72 of BEVDet); good models have about 0.27 and 0.4.
EXCHANGED_ASE, EXCHANGED_AOE = 0.55, 1.0
# The published models have 0.3 to 0.7 m/s with history, and 0.8 to 1.1 m/s without it.
NO_HISTORY_AVE = (0.8, 1.5)


def known_mistakes(metrics: Mapping[str, Any], *, temporal: bool = True) -> list[str]:
    """One line for each mistake whose pattern the scores have.

    Args:
        metrics: of `FrameScores.to_dict`. Only classes with ground truth that are found count.
        temporal: whether the model was run with history.
    """
    aps: Mapping[str, float | None] = metrics["mean_dist_aps"]
    present = [name for name in metrics["classes_with_ground_truth"]["classes"] if (aps[name] or 0.0) >= SMALLEST_AP]
    errors = metrics["label_tp_errors"]
    scale, heading, velocity = (_mean(errors, present, name) for name in ("scale_err", "orient_err", "vel_err"))
    found = []
    if scale >= EXCHANGED_ASE and heading >= EXCHANGED_AOE:
        found.append(
            f"mASE {scale:.2f} with mAOE {heading:.2f} is the pattern of boxes whose width and length are exchanged "
            "(known values: 0.71 to 0.75 with 1.3 to 1.6): check the order of the sizes and the heading"
        )
    if NO_HISTORY_AVE[0] <= velocity <= NO_HISTORY_AVE[1]:
        why = "expected here, as the model ran without history"
        if temporal:
            why = "check that the frames are in order, at 2 per second, and that the poses of the vehicle are right"
        found.append(f"mAVE {velocity:.2f} m/s is the pattern of a model without history (about 1): {why}")
    return found


def _mean(errors: Mapping[str, Mapping[str, float | None]], classes: Sequence[str], error: str) -> float:
    """The mean over the classes that have the error; 0 without any."""
    known = [value for name in classes if (value := errors[name][error]) is not None]
    return fmean(known) if known else 0.0
