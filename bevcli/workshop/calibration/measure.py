"""The measurement: rounds of rotations from points, heights from the road, and both together."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array
from bevcli.rig.overlay import visible_runs
from bevcli.workshop.calibration.levels import level_corrections, sees_road
from bevcli.workshop.calibration.matches import PointMatches
from bevcli.workshop.calibration.options import CalibrateOptions
from bevcli.workshop.calibration.residuals import RoadResiduals, values
from bevcli.workshop.calibration.road import road_residuals, search_heights
from bevcli.workshop.calibration.solve import Solution, Term, solve, spread
from bevcli.workshop.calibration.unknowns import HEIGHT, OF_CAMERA, OF_PAIR, Unknowns, geometry_at
from bevcli.workshop.calibration.views import Views

SCALES_PX = (20.0, 5.0, 1.5, 0.7)  # of Cauchy's loss for points, one search after the other
POINT_SCALE_PX, ROAD_SCALES_PX = 0.3, (3.0, 1.0, 0.5)  # then: the smallest one, and those of road points
CONSISTENT_PX, CONSISTENT_SHARE = 5.0, 0.5  # of the points of a pair of images: residual, and share of all
LEARNINGS = 4  # rounds in which the error of the vehicle's rotation is learned
SMALLEST_TURN = np.radians(0.005)  # of it
KERB_M = 0.09  # less than from the road to a pavement
FLOWS_PX = (12.0, 8.0)  # largest distance of road points from where they are expected, round by round
PARTS = 2 + 2 * len(FLOWS_PX)  # of the work, for progress
MOST_SHOWN = 60  # matches of a camera
DEPTHS_M = np.geomspace(0.7, 300, 400)  # along the ray of a point
PIECE_PX = 30.0  # length of the shown piece of an epipolar line to each side


@dataclass(frozen=True)
class Measurement:
    """What the drive says about the unknowns, and what shows it: of each camera the pair of images with most matches.

    Attributes:
        views: the frame pairs.
        matches: of all pairs.
        unknowns: their layout.
        solution: their best values, with the information and pull of each group.
        points: the matches that were used.
        road: residuals of points of the road.
    """

    views: Views
    matches: PointMatches
    unknowns: Unknowns
    solution: Solution
    points: PointMatches
    road: RoadResiduals

    def image(self, index: int) -> NDArray[np.uint8] | None:
        """(h, w) grey, the second image of the shown pair of a camera; None where it has no matches."""
        group = self._shown.get(index)
        return None if group is None else self.views.sides(self.views.groups()[group])[1].pixels

    def camera(self, index: int, *, measured: bool) -> Camera:
        """A camera of the reduced images with its stated or its measured pose."""
        camera = self.views.rig.cameras[index]
        return replace(camera, ego_from_camera=self.unknowns.ego_from_camera(self._x(measured))[index])

    def shown_matches(self, index: int, *, measured: bool) -> list[tuple[Array, list[Array]]]:
        """Some matches of the shown pair of a camera.

        Of each the pixel (2,) in the image, and its piece of the epipolar line by either calibration, as lines (P, 2).
        """
        group, camera = self._shown.get(index), self.camera(index, measured=measured)
        if group is None:
            return []
        mine = np.flatnonzero(self.matches.group == group)
        chosen = mine[:: 1 + len(mine) // MOST_SHOWN]
        motion = geometry_at(self.unknowns, self._x(measured)).camera_b_from_camera_a[group]
        pairs = zip(self.matches.pixels_b[chosen], self.matches.rays_a[chosen], strict=True)
        return [(point, _epipolar_piece(camera, motion, ray, point)) for point, ray in pairs]

    def _x(self, measured: bool) -> Array:
        return self.solution.x * (1.0 if measured else 0.0)

    @cached_property
    def _shown(self) -> dict[int, int]:
        """Camera -> the group of its shown pair."""
        counts = np.bincount(self.matches.group[self.matches.same], minlength=len(self.unknowns.groups))
        best: dict[int, int] = {}
        for group in np.argsort(counts):
            if counts[group]:
                best[int(self.unknowns.groups[group, 1])] = int(group)
        return best


def _epipolar_piece(camera: Camera, camera_b_from_camera_a: Array, ray: Array, point: Array) -> list[Array]:
    """The part of a ray's image that is nearest to a point, as lines (P, 2) in pixels."""
    points = DEPTHS_M[:, None] * ray @ camera_b_from_camera_a[:3, :3].T + camera_b_from_camera_a[:3, 3]
    pixels = camera.project(points)[0]
    distance = np.linalg.norm(pixels - point, axis=-1)
    if not np.isfinite(distance).any():
        return []
    nearest = pixels[np.nanargmin(distance)]
    near = np.linalg.norm(pixels - nearest, axis=-1) < PIECE_PX
    return visible_runs(np.where(near[:, None], pixels, np.nan))


def measure(
    views: Views, matches: PointMatches, options: CalibrateOptions, progress: Callable[[], None] = lambda: None
) -> Measurement:
    """Measure all unknowns. progress: called PARTS times."""
    unknowns = Unknowns.of(views, options)
    within, x = matches.where(matches.same), np.zeros(len(unknowns.deviations))
    for scale in SCALES_PX:
        x = solve(unknowns, [(within, scale)], x).x
    within = consistent(unknowns, within, x)
    progress()
    heights = np.arange(unknowns.cameras) * OF_CAMERA + HEIGHT
    x[heights] += search_heights(views, unknowns, x)
    progress()
    ties = matches.where(~matches.same)
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
    return Measurement(views, matches, unknowns, solution, within, road)


def _terms(unknowns: Unknowns, points: PointMatches, road: RoadResiduals, x: Array, road_scale: float) -> list[Term]:
    """Both kinds of residuals, with the spread that they have at x (P,)."""
    scales = ((points, POINT_SCALE_PX), (road, road_scale))
    return [(each, np.maximum(least, spread(unknowns, each, x))) for each, least in scales]


def consistent(unknowns: Unknowns, points: PointMatches, x: Array) -> PointMatches:
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
