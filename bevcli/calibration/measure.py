"""The measurement: rounds of rotations from points, heights from the road, and both together; what the drive shows."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from bevcli.calibration.estimates import RigEstimate
from bevcli.calibration.levels import level_corrections, sees_road
from bevcli.calibration.matches import PointMatches
from bevcli.calibration.options import CalibrateOptions
from bevcli.calibration.residuals import EpipolarResiduals, RoadResiduals, epipolar_residuals, values
from bevcli.calibration.road import road_residuals, search_heights
from bevcli.calibration.solve import Solution, Term, solve, spread
from bevcli.calibration.unknowns import HEIGHT, OF_CAMERA, OF_PAIR, OF_RIG, Unknowns
from bevcli.calibration.views import Views
from bevcli.geometry.transforms import Array

SCALES_PX = (20.0, 5.0, 1.5, 0.7)  # of Cauchy's loss for points, one search after the other
POINT_SCALE_PX, ROAD_SCALES_PX = 0.3, (3.0, 1.0, 0.5)  # then: the smallest one, and those of road points
CONSISTENT_PX, CONSISTENT_SHARE = 5.0, 0.5  # of the points of a pair of images: residual, and share of all
LEARNINGS = 4  # rounds in which the error of the vehicle's rotation is learned
SMALLEST_TURN = np.radians(0.005)  # of it
KERB_M = 0.09  # less than from the road to a pavement
FLOWS_PX = (12.0, 8.0)  # largest distance of road points from where they are expected, round by round
PARTS = 2 + 2 * len(FLOWS_PX)  # of the work, for progress
LEAST_INFORMATION = 3.0  # of a direction, in that of the stated value: the deviation is then halved at least
LEAST_FACTOR = 0.5  # of variances, by which the agreement of the pairs may make them smaller
FINEST = np.array([np.radians(0.01)] * 3 + [0.001] * 3 + [0.001])  # errors of lens and images: radians, metres, seconds


@dataclass(frozen=True)
class Measurement:
    """What the drive says about the unknowns.

    Attributes:
        unknowns: their layout.
        solution: their best values, with the information and pull of each group.
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
    within = consistent(unknowns, within, x)
    progress()
    heights = np.arange(unknowns.cameras) * OF_CAMERA + HEIGHT
    x[heights] += search_heights(views, unknowns, x)
    progress()
    ties = points.where(~matches.same)
    for most_px in FLOWS_PX:
        road = road_residuals(views, unknowns, x, most_px)
        progress()
        for scale in ROAD_SCALES_PX:
            x = solve(unknowns, _terms(unknowns, within, road, x, scale), x).x
        if most_px == FLOWS_PX[0]:
            levels = level_corrections(unknowns, road, ties, x)
            x = x + levels
            # Shared points tell the level, and the road then tells the height to the step of the search.
            x[heights] += search_heights(views, unknowns, x, levels[heights] != 0, KERB_M)
        progress()
    road = road.where(sees_road(unknowns, road, ties, x)[unknowns.groups[road.group, 1]])
    for _ in range(LEARNINGS):
        solution = solve(unknowns, _terms(unknowns, within, road, x, ROAD_SCALES_PX[-1]), x)
        x, unknowns = solution.x, with_learned_turns(unknowns, solution)
    return Measurement(unknowns, solution, within, road)


def _terms(
    unknowns: Unknowns, points: EpipolarResiduals, road: RoadResiduals, x: Array, road_scale: float
) -> list[Term]:
    """Both kinds of residuals, with the spread that they have at x (P,)."""
    scales = ((points, POINT_SCALE_PX), (road, road_scale))
    return [Term(each, np.maximum(least, spread(unknowns, each, x))) for each, least in scales]


def consistent(unknowns: Unknowns, points: EpipolarResiduals, x: Array) -> EpipolarResiduals:
    """The points that fit at x (P,), of the image pairs in which most of them do.

    Repeated texture gives pairs whose matches fit a motion, but not that of the vehicle.
    """
    fits = np.abs(values(unknowns, points, x)[:, 0]) < CONSISTENT_PX
    count = len(unknowns.groups)
    fitting, found = (np.bincount(each, minlength=count) for each in (points.group[fits], points.group))
    shares = fitting / np.maximum(found, 1)
    return points.where(fits & (shares[points.group] >= CONSISTENT_SHARE))


def with_learned_turns(unknowns: Unknowns, solution: Solution) -> Unknowns:
    """The unknowns with the deviation of the vehicle's stated rotation that its pairs show, at most the present one.

    It is estimated an axis, as the scatter of the solution over what the pairs determine (MacKay's rule).
    """
    deviations = unknowns.deviations.copy()
    start = OF_CAMERA * unknowns.cameras
    turns = slice(start, start + OF_PAIR * unknowns.pairs)
    covariance = np.linalg.inv(solution.information + np.diag(1 / deviations**2))
    determined = (1 - np.diag(covariance)[turns] / deviations[turns] ** 2).reshape(-1, OF_PAIR).sum(0)
    squares = (solution.x[turns] ** 2).reshape(-1, OF_PAIR).sum(0)
    learned = np.maximum(np.sqrt(squares / np.maximum(determined, 1)), SMALLEST_TURN)
    deviations[turns] = np.minimum(deviations[turns], np.tile(learned, unknowns.pairs))
    return replace(unknowns, deviations=deviations)


def observed(measurement: Measurement) -> tuple[Array, Array, RigEstimate]:
    """The changes along directions that the drive shows, with their covariance; all else stays as it is stated.

    Returns:
        (C, 7) rotation, radians in the camera frame; position, metres in the ego frame; delay, seconds.
        (C, 7, 7) covariances of them; a direction that is not observed has the deviation of the stated value.
        The whole rig.
    """
    unknowns, solution = measurement.unknowns, measurement.solution
    deviations, count = unknowns.deviations, OF_CAMERA * unknowns.cameras
    covariance = _honest(unknowns, solution)
    scale = deviations[:count]
    marginal = np.linalg.inv(covariance[:count, :count] / np.outer(scale, scale)) - np.eye(count)
    sizes, axes = np.linalg.eigh((marginal + marginal.T) / 2)
    seen, unseen = axes[:, sizes >= LEAST_INFORMATION], axes[:, sizes < LEAST_INFORMATION]
    change = scale * (seen @ (seen.T @ (solution.x[:count] / scale)))
    within = seen @ np.diag(1 / (1 + sizes[sizes >= LEAST_INFORMATION])) @ seen.T + unseen @ unseen.T
    whole = np.outer(scale, scale) * within + np.diag(np.tile(FINEST, unknowns.cameras) ** 2)
    blocks = whole.reshape(unknowns.cameras, OF_CAMERA, unknowns.cameras, OF_CAMERA)
    changes = unknowns.of_camera(change)
    of_rig, of_rig_deviations = solution.x[-OF_RIG:], np.sqrt(np.diag(covariance)[-OF_RIG:])
    (along, across), (along_deviation, across_deviation) = np.degrees([of_rig[1:], of_rig_deviations[1:]]).tolist()
    rig = RigEstimate(
        scale=float(of_rig[0]),
        scale_deviation=float(of_rig_deviations[0]),
        height_m=-float(changes[:, HEIGHT].mean()),
        height_deviation_m=float(np.sqrt(blocks[:, HEIGHT, :, HEIGHT].sum()) / unknowns.cameras),
        tilt_deg=(along, across),
        tilt_deviation_deg=(along_deviation, across_deviation),
    )
    return changes, np.stack([blocks[c, :, c] for c in range(unknowns.cameras)]), rig


def _honest(unknowns: Unknowns, solution: Solution) -> Array:
    """The covariance (P, P), each unknown scaled by how well the frame pairs agree about it: the jackknife.

    The result without a pair differs by what that pair pulls. So an unknown that a single pair tells is not believed,
    however small its residuals are.
    """
    prior = np.diag(1 / unknowns.deviations**2)
    matrix = solution.information + prior
    covariance: Array = np.asarray(np.linalg.inv(matrix), dtype=np.float64)
    pulls = []
    for pair in range(unknowns.pairs):
        groups = unknowns.groups[:, 0] == pair
        pulls.append(np.linalg.solve(matrix - solution.information_of(groups), solution.gradient_of(groups)))
    agreed = (np.square(pulls).sum(0) + np.diag(covariance @ prior @ covariance)) / np.diag(covariance)
    factor = np.sqrt(np.maximum(agreed, LEAST_FACTOR))
    return covariance * np.outer(factor, factor)
