"""The nuScenes devkit's scores of tracks, comparison of two models, worst frames, and plots of detection scores."""

from bevcli.evaluation import Scorer
from bevcli.options import option, options


@options()
class TrackingScoreOptions:
    """Whether tracks are scored."""

    tracking: bool = option(
        default=False, help="Also score tracks: AMOTA, identity switches and the other tracking metrics."
    )


SCORER = Scorer(TrackingScoreOptions, "bevcli.workshop.scores.tracking:score_tracks")


@options()
class WorstOptions:
    """Whether the worst frames are listed."""

    worst: int | None = option(
        default=None,
        help="List the N frames with most missed and most invented boxes. Default: none for one file of predictions, "
        "3 for two.",
        metavar="N",
        minimum=1,
    )


WORST = Scorer(WorstOptions, "bevcli.workshop.scores.worst_frames:score_worst_frames")
