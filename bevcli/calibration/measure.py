"""The measurement: rounds of rotations from points, heights from the road, and both together."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from bevcli.calibration.heights import search_heights
from bevcli.calibration.levels import level_corrections, sees_road
from bevcli.calibration.matches import PointMatches
from bevcli.calibration.options import CalibrateOptions
from bevcli.calibration.residuals import EpipolarResiduals, RoadResiduals, epipolar_residuals
from bevcli.calibration.road import road_residuals
from bevcli.calibration.solve import Solution, Term, solve, spread
from bevcli.calibration.unknowns import HEIGHT, OF_CAMERA, Unknowns
from bevcli.calibration.views import Views

SCALES_PX = (20.0, 5.0, 1.5, 0.7)  # of Cauchy's loss for points, one search after the other
ROAD_SCALES_PX = (3.0, 1.0, 0.5)
FLOWS_PX = (12.0, 8.0)  # largest distance of road points from where they are expected, round by round
PARTS = 2 + 2 * len(FLOWS_PX)  # of the work, for progress


@dataclass(frozen=True)
class Measurement:
    """What the drive says about the unknowns.

    Attributes:
        unknowns: their layout.
        solution: their best values, with information and scatter.
        points: residuals of matched points.
        road: residuals of points of the road.
    """

    unknowns: Unknowns
    solution: Solution
    points: EpipolarResiduals
    road: RoadResiduals


def measure(
    views: Views, matches: PointMatches, options: CalibrateOptions, progress: Callable[[], None] = lambda: None
) -> Measurement:
    """Measure all unknowns. progress: called PARTS times."""
    unknowns = Unknowns.of(views, options)
    points = epipolar_residuals(views, matches)
    within, x = points.where(matches.same), np.zeros(len(unknowns.deviations))
    for scale in SCALES_PX:
        x = solve(unknowns, [Term(within, scale)], x).x
    progress()
    heights = np.arange(unknowns.cameras) * OF_CAMERA + HEIGHT
    x[heights] += search_heights(views, unknowns, x)
    progress()
    ties = points.where(~matches.same)
    for most_px in FLOWS_PX:
        road = road_residuals(views, unknowns, x, most_px)
        progress()
        for scale in ROAD_SCALES_PX:
            terms = [Term(each, max(s, spread(unknowns, each, x))) for each, s in ((within, 0.3), (road, scale))]
            solution = solve(unknowns, terms, x)
            x = solution.x
        if most_px == FLOWS_PX[0]:
            x = x + level_corrections(unknowns, ties, x)
        progress()
    certain = road.where(sees_road(unknowns, road, ties, x)[unknowns.groups[road.group, 1]])
    if len(certain.group) < len(road.group):
        road, solution = certain, solve(unknowns, [terms[0], Term(certain, terms[1].scale)], x)
    return Measurement(unknowns, solution, within, road)
