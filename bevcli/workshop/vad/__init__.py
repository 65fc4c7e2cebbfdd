"""VAD (Jiang et al. 2023): BEVFormer's BEV map, lines of the map, forecasts of all objects, and a planned path."""

from bevcli.evaluation import Scorer
from bevcli.options import option, options


@options()
class DrivingScoreOptions:
    """Which results are scored."""

    map: bool = option(default=False, help="Also score lines of the map: AP by Chamfer distance of 0.5, 1 and 1.5 m.")
    motion: bool = option(default=False, help="Also score forecasts: EPA, minADE, minFDE and miss rate.")
    plan: bool = option(
        default=False,
        help="Also score planned paths: distance to the driven path and collisions, up to 1, 2 and 3 s as VAD states "
        "them, and at 1, 2 and 3 s as UniAD does.",
    )


SCORER = Scorer(DrivingScoreOptions, "bevcli.workshop.vad.driving_scores:evaluate_driving")
