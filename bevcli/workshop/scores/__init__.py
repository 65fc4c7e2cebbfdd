"""Scores of predictions: the nuScenes metrics of boxes and tracks, IoU of BEV maps, comparison of two models, plots.

evaluate            the entry point: reads predictions and ground truth, scores them; dict for JSON, and tables
inputs              predictions and ground truth from files, folders or a nuScenes root, and pairs of their frames
detection           boxes of many frames -> AP, mAP, true-positive errors, NDS; reads no files
tracking            boxes with identities -> the track of each object -> AMOTA and what comes with it
compare             two models on the same frames, with intervals from frames that are drawn again
worst_frames        the frames with most missed and most invented boxes
tables              a table of scores as text, CSV and LaTeX
record              a drive with its labels, and boxes of models, as a recording
"""

from pathlib import Path

from bevcli.options import option, options

# Of every command that scores boxes.
MAX_RANGE_HELP = (
    "Score nothing beyond this distance from the ego vehicle, nor beyond nuScenes' range of the class. Default: where "
    "the model's BEV grid ends."
)


@options()
class EvaluationOptions:
    """The options of `evaluate` for boxes and maps, and the files of its plots and tables."""

    plot: Path | None = option(
        default=None,
        help="Write plots: precision and recall, errors by range, missed objects and false positives from above. A "
        ".pdf, .svg or .png file gets precision and recall alone.",
        metavar="DIR|FILE",
    )
    csv: Path | None = option(
        default=None,
        help="Write all tables as CSV: table, row, column and value, one row a number, not rounded.",
        metavar="FILE",
    )
    latex: Path | None = option(default=None, help="Write all tables as LaTeX, with booktabs.", metavar="FILE")
    max_range: float | None = option(default=None, help=MAX_RANGE_HELP, metavar="METRES")
    count_missing: bool = option(default=False, help="Count ground-truth frames without a prediction as missed.")


@options()
class ResultOptions:
    """Further results that are scored."""

    tracking: bool = option(
        default=False, help="Also score tracks: AMOTA, identity switches and the other tracking metrics."
    )
    map: bool = option(default=False, help="Also score lines of the map: AP by Chamfer distance of 0.5, 1 and 1.5 m.")
    motion: bool = option(default=False, help="Also score forecasts: EPA, minADE, minFDE and miss rate.")
    plan: bool = option(
        default=False,
        help="Also score planned paths: distance to the driven path and collisions, up to 1, 2 and 3 s as VAD states "
        "them, and at 1, 2 and 3 s as UniAD does.",
    )
    worst: int | None = option(
        default=None,
        help="List the N frames with most missed and most invented boxes, without ground truth those that differ most "
        "from the detector. Default: none for one file of predictions, 3 for two.",
        metavar="N",
        minimum=1,
    )
