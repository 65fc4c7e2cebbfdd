"""Scores of predictions: the nuScenes detection metrics, and IoU of BEV maps. Options, and `Scorer`.

    evaluate            the entry point: reads predictions and ground truth, scores them; dict for JSON, and tables

Input:
    inputs              predictions and ground truth from files, folders or a nuScenes root, and pairs of their frames

Metrics; they read no files:
    detection           boxes of many frames -> AP, mAP, true-positive errors, NDS
    matching            parameters of the score, and greedy matching of boxes

Output:
    box_format          formats that boxes are exported in
    submission          nuScenes submissions, which are read too
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from bevcli.options import option, options
from bevcli.registry import entries, load

SCORES: Final = "bevcli.scores"
# Of every command that scores boxes.
MAX_RANGE_HELP = (
    "Score nothing beyond this distance from the ego vehicle, nor beyond nuScenes' range of the class. Default: where "
    "the model's BEV grid ends."
)


@options()
class EvaluationOptions:
    """The options of `evaluate` for boxes and maps, and the folder of its plots."""

    plot: Path | None = option(
        default=None,
        help="Write plots: precision and recall, errors by range, missed objects and false positives from above.",
        metavar="DIR",
    )
    max_range: float | None = option(default=None, help=MAX_RANGE_HELP, metavar="METRES")
    count_missing: bool = option(default=False, help="Count ground-truth frames without a prediction as missed.")


@options()
class ExportOptions:
    """The format of exported boxes and what it needs."""

    form: str = option(
        help="csv: one table. json: a boxes file, as predictions.json. kitti: label_2 and calib. "
        "nuscenes: results_nusc.json. nuscenes-tracking: tracking_nusc.json. Or the format of an installed package.",
        flag="--format",
        metavar="NAME",
        complete=lambda incomplete: list(entries("bevcli.box_formats")),
    )
    out: Path | None = option(
        default=None, help="Default: a name that depends on the format, such as boxes.csv, next to PREDICTIONS."
    )
    score: float = option(default=0.0, help="Leave out boxes scored below this.", minimum=0, maximum=1)
    calibration: Path | None = option(
        reads="path",
        default=None,
        help="kitti: calibration.json, or the sequence folder that contains it. Default: the one next to PREDICTIONS.",
    )
    camera: str | None = option(
        default=None, help="kitti: the camera. Default: CAM_FRONT, else the one that looks most directly ahead."
    )


@dataclass(frozen=True)
class Scorer:
    """What computes the scores of further results of a model, such as tracks, registered under `bevcli.scores`.

    Attributes:
        options: a dataclass of options, which are False or None by default. One with another value turns the scorer on.
        function: "module:function", imported when it is used. It takes the options and a `Compared`, and returns
            `ResultScores`. It raises InputError where a side lacks what is scored.
    """

    options: type[Any]
    function: str


def score_options() -> list[type[Any]]:
    """The dataclasses of the scorers' options."""
    return [load(SCORES, name).options for name in entries(SCORES)]
