"""The nuScenes devkit's scores of tracks, and plots of detection scores."""

from bevcli.evaluation import Scorer
from bevcli.options import option, options


@options()
class TrackingScoreOptions:
    """Whether tracks are scored."""

    tracking: bool = option(
        default=False, help="Also score tracks: AMOTA, identity switches and the other tracking metrics."
    )


SCORER = Scorer(TrackingScoreOptions, "bevcli.workshop.scores.tracking:score_tracks")
