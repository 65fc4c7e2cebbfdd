"""The motion between two frames: starts from matched points and votes, and what fits points and road best."""

from collections.abc import Sequence as Items
from dataclasses import dataclass, fields, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array
from bevcli.workshop.correspondence.images import RoadPoints, road_points
from bevcli.workshop.correspondence.residuals import (
    EpipolarResiduals,
    GroupGeometry,
    Indices,
    Residuals,
    RoadResiduals,
    Term,
    honest_covariance,
    solve,
    spread,
    values,
)
from bevcli.workshop.odometry.step_views import (
    BEGIN_M,
    CELL_M,
    CHANGE_RAD,
    COUNT,
    PARTS,
    PLACE,
    SHAPE,
    SHORTEST_M,
    SLOPE_RAD,
    SLOPES,
    STATE,
    GroundResiduals,
    RoadPicture,
    StepUnknowns,
    StepViews,
    deviations_at,
    match_points,
    moved_picture,
    next_slopes,
    rays_and_weights,
    road_flow,
    still_points,
)

TILE, ASIDE = 25, 2  # cells: side of a tile, and by how much it may lie beside the way
LEAST_SEEN, LEAST_CONTRAST = 0.8, 8.0  # of a tile: share, and grey levels of standard deviation
NOTHING, MOST = 0.15, 2.0  # of the vote of a tile, less of which is chance, and which is the largest
BESIDE_M = 5.0  # tiles farther beside the vehicle count less: they are less often road


def distance_votes(
    first: RoadPicture, second: RoadPicture, heading: float, yaw: float, cells: tuple[int, int]
) -> tuple[Array, Array]:
    """Distances (D,) in metres, and the votes (D,) of the tiles of the road for each.

    heading: direction of the way in the first ego frame. yaw: by which the vehicle turned. cells: least and largest
    distance, a negative one is driven backwards.
    """
    turns = (first, heading), (second, heading - yaw)
    a, b = (moved_picture(picture, angle, np.zeros(2)) for picture, angle in turns)  # the way is along x
    shifts = np.arange(cells[0], cells[1] + 1)
    distances = np.asarray(CELL_M * shifts, dtype=np.float64)
    correlations, weights = [], []
    (height, width), last = SHAPE, SHAPE[1] - TILE
    for row in range(ASIDE, height - TILE - ASIDE + 1, TILE):
        strip = np.ascontiguousarray(b.texture[row - ASIDE : row + TILE + ASIDE])
        covered = cv2.boxFilter(b.seen[row : row + TILE].mean(0, dtype=np.float32)[None], -1, (TILE, 1), anchor=(0, 0))
        beside = BEGIN_M[1] + (row + TILE / 2) * CELL_M
        for column in range(0, width - TILE + 1, TILE):
            tile = np.s_[row : row + TILE, column : column + TILE]
            if a.seen[tile].mean() < LEAST_SEEN or a.texture[tile].std() < LEAST_CONTRAST:
                continue
            alike = cv2.matchTemplate(strip, np.ascontiguousarray(a.texture[tile]), cv2.TM_CCOEFF_NORMED).max(0)
            at = column - shifts
            inside = (at >= 0) & (at <= last)
            usable = inside & (covered[0, at.clip(0, last)] >= LEAST_SEEN)
            correlations.append(np.where(usable, alike[at.clip(0, last)], np.nan))
            weights.append(np.exp(-((beside / BESIDE_M) ** 2)))
    if not correlations:
        return distances, np.zeros(len(shifts))
    return distances, _summed(np.stack(correlations), np.array(weights))


def _summed(correlations: Array, weights: Array) -> Array:
    """(D,) votes of tiles with correlations (tiles, D): what a tile says of a distance beyond what it says of all."""
    seen = np.isfinite(correlations)
    votes = -np.log(1.001 - np.clip(np.nan_to_num(correlations), 0, 1))
    usual = np.array([np.median(vote[mask]) if mask.any() else 0.0 for vote, mask in zip(votes, seen, strict=True)])
    votes = np.where(seen, np.clip(votes - usual[:, None] - NOTHING, 0, MOST), 0)
    return np.asarray((weights[:, None] * votes).sum(0) / np.sqrt(1 + (weights[:, None] * seen).sum(0)))


LEAST_PX = 1.5  # of the way in the image that is due to driving, without the turn
LEAST_DOWN = 0.03  # sine of the angle below the horizon
FEWEST_VOTES, FEWEST_FOR_ALL = 15, 30  # points that vote for a way, and that tell which of them drive by themselves
WIDTH = 0.12  # deviation of the logarithm of a point's way
CHANCE = 0.15  # of the votes that a distance has without such a point
UNDER = 0.7  # of the way of most points
STILL_PX, STILL_SHARE = 0.35, 0.85  # of matched points of a vehicle that stands
NEAR_DOWN, FEWEST_NEAR = 0.08, 8  # sine of the angle below the horizon of near points, and how many tell something
FEWEST_STILL = 30  # matched points that tell whether a vehicle stands


def stands(points: EpipolarResiduals, ego_from_camera: Array) -> bool:
    """True where most matched points of single cameras stay in the image, and half of those near the vehicle.

    Far points stay also where the vehicle creeps. ego_from_camera: (N, 4, 4) of each point.
    """
    moved_px = np.linalg.norm(points.rays_a - points.rays_b, axis=-1) * points.focal
    near = -np.einsum("nj,nj->n", ego_from_camera[:, 2, :3], points.rays_a) > NEAR_DOWN
    if len(moved_px) < FEWEST_STILL or (moved_px < STILL_PX).mean() < STILL_SHARE:
        return False
    return bool(near.sum() < FEWEST_NEAR or np.median(moved_px[near]) < STILL_PX)


def ways_of_points(points: EpipolarResiduals, geometry: GroupGeometry, length: float) -> Array:
    """(n,) metres: the ways with which points of single cameras lie on the road; NaN for those that tell none.

    length: way of the motion of the geometry.
    """
    relative, pose = geometry.camera_b_from_camera_a[points.group], geometry.ego_from_camera_a[points.group]
    turned = np.einsum("nij,nj->ni", relative[:, :3, :3], points.rays_a)
    moved_px = np.linalg.norm(np.cross(turned, points.rays_b), axis=-1) * points.focal
    normal = np.array([*-geometry.slopes, 1.0])
    down = -np.einsum("nij,nj->ni", pose[:, :3, :3], points.rays_a) @ normal
    depths = points.depths(geometry)
    kept = (moved_px > LEAST_PX) & (down > LEAST_DOWN) & (np.prod(np.sign(depths), axis=-1) > 0)
    ways = np.full(len(kept), np.nan)
    ways[kept] = length * (pose[kept, :3, 3] @ normal) / down[kept] / np.abs(depths[kept, 0])
    return ways


def point_votes(ways: Array, distances: Array) -> Array:
    """(D,) factors up to 1, of the votes of the road for distances (D,): the share of the points that agree."""
    told = ways[np.isfinite(ways)]
    if len(told) < FEWEST_VOTES:
        return np.ones(len(distances))
    shares = _shares(told, distances)
    return np.asarray(CHANCE + (1 - CHANCE) * shares / max(float(shares.max()), 1e-9))


def under_the_road(ways: Array) -> NDArray[np.bool_]:
    """(n,) True for points that would lie deep under the road: they belong to vehicles that drive ahead."""
    told = ways[np.isfinite(ways)]
    if len(told) < FEWEST_FOR_ALL:
        return np.zeros(len(ways), dtype=bool)
    return np.nan_to_num(ways, nan=np.inf) < UNDER * told[int(np.argmax(_shares(told, told)))]


def _shares(ways: Array, distances: Array) -> Array:
    """(D,) the shares of points with ways (n,) that agree with distances (D,)."""
    logarithms = np.log(np.maximum(np.abs(distances), 1e-3))
    apart = (np.log(ways)[:, None] - logarithms) / WIDTH
    return np.asarray(np.exp(-(apart**2) / 2).mean(0))


YAWS = np.radians(np.arange(-60, 60.1, 3.0))  # that are tried, besides those of the last step
FEWEST, FEWEST_OF_ROAD = 30, 60  # matched points, and points of the road in the images
STANDING = np.array([*np.radians([0.3] * 3), 0.02, 0.02, 0.01, 1, 1, 1])  # deviations of its motion
CLEAR_M, CLEAR_SHARE = 60.0, 0.4  # of points that tell whether the vehicle drives backwards
WIDEST_M, WIDEST = 0.3, 0.3  # deviation of the way of a step that counts as measured, and as a share of the way
WIDEST_RAD = np.radians(1.5)  # the same of the turn
WAY_M = 3.5  # points of the road nearer to the way are preferred
LEAST_M = 0.12  # of a start: without a way, points have no epipolar lines
USUAL_M = 4.0  # distance at which directions are searched
ROUGH_PX, FINE_PX = 6.0, 0.4  # of residuals while directions are searched, at first and at last
FASTEST, BACK = 45.0, 6.0  # m/s, of the distances that are tried
MOST_M = (0.8, 0.25)  # between points of the road and where they are expected, pass by pass
ROAD_PX = 60.0  # the same in one image, for a metre
MOST_PX = (30.0, 8.0)  # of points of two cameras
LEAST_SHARE = 0.3  # of the points of two cameras that fit; where fewer do, both see nothing in common
LEAST_SPREAD, MOST_SPREAD = 0.3, 2.0  # of residuals, while the motion is searched
CANDIDATES = 3  # distances of a step that are measured
LEAST_VOTES = 0.5  # share of the most votes, of another distance that is measured
SHORT = 0.25  # of the way that matched points tell
FEW = 10  # points of the road, of a motion that has none of its own
CLIMB = 5  # cells, to the most votes of the road near a distance on which matched points agree
APART_M = 0.4  # between them
FLOOR = np.diag([*[np.radians(0.002)] * 3, *[0.0005] * 3]) ** 2  # of the covariance: the calibration is no better
STILL_FLOOR = np.diag([*[np.radians(0.01)] * 3, *[0.005] * 3]) ** 2  # the same of a vehicle that stands or creeps
SURE_OF_ROAD, UNSURE = 15, 2.0  # points of the road, and the factor of all deviations where there are fewer
MANY = 3  # cameras, whose agreement tells the deviations too
NO_POINTS = RoadPoints(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 2, 3)), np.zeros(0))
MOST_SEEN = 60  # points for recordings, of each camera and kind


@dataclass(frozen=True)
class SeenPoints:
    """Some of the points that a step was measured from, in the images of its second frame: what a recording shows."""

    camera: NDArray[np.int16]  # (N,) index in the rig
    at: NDArray[np.float32]  # (N, 2) position in the image of the second frame, as shares of its width and height
    residuals_px: NDArray[np.float32]  # (N,) distance from where the measured motion puts it, of the reduced image
    is_road: NDArray[np.bool_]  # (N,) True for a point of the road, False for a matched one


def seen_points(cameras: Items[Camera], *kinds: tuple[Indices, Array, Array]) -> SeenPoints:
    """An even choice of points.

    cameras: of the second frame. kinds: matched points and points of the road, each with the camera (n,), the ray
    (n, 3) in its frame, and the residual (n, D).
    """
    columns: list[tuple[Indices, Array, Array, NDArray[np.bool_]]] = []
    for is_road, (of, rays, residuals) in enumerate(kinds):
        for index, camera in enumerate(cameras):
            mine = np.flatnonzero(of == index)
            selected = mine[:: max(1, -(-len(mine) // MOST_SEEN))]
            pixels, _ = camera.project(rays[selected])
            sizes = np.linalg.norm(residuals[selected], axis=-1)
            roads = np.full(len(selected), bool(is_road))
            columns.append((np.full(len(selected), index), pixels / (camera.width, camera.height), sizes, roads))
    camera_of, at, sizes, roads = (np.concatenate(column) for column in zip(*columns, strict=True))
    return SeenPoints(camera_of.astype(np.int16), at.astype(np.float32), sizes.astype(np.float32), roads)


@dataclass(frozen=True)
class Candidate:
    """A motion that a step may have."""

    state: Array  # (8,), see `StepUnknowns`
    covariance: Array  # (6, 6) of rotation and translation
    votes: float  # of the road for its distance
    matches: int  # number of matched points
    road_points: int  # number of points of the road
    seen: SeenPoints | None = None  # some of both
    slopes_told: float = 0.0  # the information of the images about the slopes of the road; 1 for SLOPE_RAD

    def speed_and_rate(self, seconds: float) -> Array:
        """(2,) the speed (m/s, negative backwards) and the yaw rate (radians a second) of a step of some seconds."""
        return np.array([np.copysign(np.hypot(*self.state[3:5]), self.state[3]), self.state[2]]) / seconds


@dataclass(frozen=True)
class Guess:
    """What is expected of a step from the one before."""

    state: Array | None  # (8,), see `StepUnknowns`; None where nothing is known
    height_m: float  # standard deviation of the stated heights of the cameras
    still: bool = False  # whether the vehicle stands, as all points show

    @property
    def slopes(self) -> Array:
        """(2,) of the road."""
        return np.zeros(2) if self.state is None else self.state[SLOPES]

    def deviations(self, start: Array, *, known_distance: bool = False) -> Array:
        """(9,) of the unknowns."""
        slope = SLOPE_RAD if self.state is None else CHANGE_RAD
        result = deviations_at(start, self.height_m, slope, known_distance=known_distance)
        return np.minimum(result, STANDING) if self.still else result


def direction(step: StepViews, points: EpipolarResiduals, guess: Guess) -> Array:
    """(8,) the motion that fits the matched points of single cameras; its length is that of the guess, if any."""
    inside = step.of_single_cameras(points)
    expected, length = guess.state, USUAL_M
    if expected is not None and np.hypot(*expected[3:5]) > SHORTEST_M:
        length = float(expected[3])
    arcs = (
        (yaw, length * np.cos(yaw / 2), length * np.sin(yaw / 2)) for yaw in YAWS
    )  # of a vehicle along each of them
    starts = [np.array([0, 0, *arc, 0, *guess.slopes]) for arc in arcs] + ([] if expected is None else [expected])
    costs = []
    for start in starts:
        unknowns = step.unknowns(start, guess.deviations(start, known_distance=True))
        squares = (values(unknowns, inside, np.zeros(COUNT)) ** 2).sum(-1)
        costs.append(float(np.log1p(squares / ROUGH_PX**2).sum()))
    best = starts[int(np.argmin(costs))]
    for scale in (ROUGH_PX, 1.0, FINE_PX):
        unknowns = step.unknowns(best, guess.deviations(best, known_distance=True))
        seen_px = np.minimum(spread(unknowns, inside, np.zeros(COUNT), 0 * inside.group), ROUGH_PX)
        best = best + solve(unknowns, [(inside, np.maximum(scale, seen_px))], np.zeros(COUNT)).x[STATE]
        if scale < ROUGH_PX:
            inside = inside.where(~under_the_road(_ways(step, inside, best)))
    return best


def candidates(step: StepViews, guess: Guess) -> list[Candidate]:
    """The motions that a step may have, those with most votes first; none where the images do not tell it."""
    points = match_points(step)
    inside, poses = still_points(step, points), np.stack([camera.ego_from_camera for camera in step.first.cameras])
    if stands(inside, poses[step.pair(inside.group)[0]]):
        start = np.concatenate([np.zeros(6), guess.slopes])
        return [measured(step, points, start, replace(guess, still=True), 1.0, None)]
    if len(points.group) < FEWEST:
        return []
    rough = direction(step, points, guess)
    heading = float(np.arctan2(rough[4] * np.sign(rough[3]), abs(rough[3])))
    cells = int(-BACK * step.seconds / CELL_M) - 4, int(FASTEST * step.seconds / CELL_M) + 4
    sense, ways = _sense(step, points, rough), _ways(step, points, rough)
    points = points.where(~under_the_road(ways))
    roads = step.first.road(rough[SLOPES]), step.second.road(next_slopes(rough))
    distances, of_road = distance_votes(*roads, heading, float(rough[2]), cells)
    of_road[np.sign(distances) == -sense] = 0
    votes = of_road * point_votes(ways, distances)
    starts = []
    for index in _peaks(votes)[:CANDIDATES]:
        start, way = rough.copy(), distances[_top(of_road, index)]
        distance = max(abs(way), LEAST_M) * (sense or np.sign(way) or 1)
        start[3:5] = distance * np.array([np.cos(heading), np.sin(heading)])
        starts.append((start, float(votes[index])))
    # Without road, two cameras may still tell the distance.
    motions = [measured(step, points, start, guess, vote, roads) for start, vote in starts or [(rough, 1.0)]]
    # Where matched points tell a far longer way, the points of the road are drops on the lens, or the own shadow.
    least = SHORT * float(np.nanmedian(ways)) if np.isfinite(ways).any() else 0.0
    counts = [motion.road_points if np.hypot(*motion.state[3:5]) > least else 0 for motion in motions]
    shares = (FEW + np.array(counts)) / (FEW + max(counts))
    return [replace(motion, votes=motion.votes * float(share)) for motion, share in zip(motions, shares, strict=True)]


def _sense(step: StepViews, points: EpipolarResiduals, rough: Array) -> int:
    """1 for a vehicle that drives forwards, -1 for backwards, since points are in front of cameras; 0: not clear."""
    depths = step.of_single_cameras(points).depths(step.geometry(rough))
    near = depths[(np.abs(depths) < CLEAR_M).all(-1)]
    if len(near) < FEWEST:
        return 0
    share = float((near > 0).all(-1).mean() - (near < 0).all(-1).mean())
    return int(np.sign(share) * np.sign(rough[3])) if abs(share) > CLEAR_SHARE else 0


def _ways(step: StepViews, points: EpipolarResiduals, state: Array) -> Array:
    """(n,) the ways with which matched points of single cameras lie on the road; NaN for those that tell none."""
    ways = ways_of_points(points, step.geometry(state), float(np.hypot(*state[3:5])))
    return np.where(np.equal(*step.pair(points.group)), ways, np.nan)


def _peaks(votes: Array) -> list[int]:
    """The indices of the distances with most votes, most first."""
    remaining, apart = votes.copy(), round(APART_M / CELL_M)
    peaks: list[int] = []
    while remaining.max() > 0 and remaining.max() >= LEAST_VOTES * votes.max():
        peaks.append(int(remaining.argmax()))
        remaining[max(0, peaks[-1] - apart) : peaks[-1] + apart + 1] = 0
    return peaks


def _top(votes: Array, index: int) -> int:
    """The index of the most votes near one, or the same where votes only rise towards others."""
    first = max(0, index - CLIMB)
    top = first + int(votes[first : index + CLIMB + 1].argmax())
    return top if abs(top - index) < CLIMB else index


def measured(
    step: StepViews,
    points: EpipolarResiduals,
    start: Array,
    guess: Guess,
    votes: float,
    roads: tuple[RoadPicture, RoadPicture] | None,
) -> Candidate:
    """The motion near a start (8,) that fits points and road best."""
    deviations = guess.deviations(start)
    unknowns, x = step.unknowns(start, deviations), np.zeros(len(deviations))
    for most_m, most_px in zip(MOST_M, MOST_PX, strict=True):
        fitting = still_points(step, points) if guess.still else _common(step, unknowns, points, x, most_px)
        road: GroundResiduals | RoadResiduals = _road_in_images(step, unknowns, x, ROAD_PX * most_m)
        if len(road.group) < FEWEST_OF_ROAD and roads is not None:
            road = _road(step, unknowns, x, roads, most_m)
        terms = _terms(step, unknowns, (fitting, road), x)
        x = solve(unknowns, [(term, np.clip(scale, LEAST_SPREAD, MOST_SPREAD)) for term, scale in terms], x).x
    solution = solve(unknowns, _terms(step, unknowns, (fitting, road), x), x)
    groups = np.arange(len(unknowns.columns))
    covariances = [honest_covariance(unknowns, solution, parts) for parts in (groups, step.pair(groups)[0])]
    covariance = max(
        covariances[: 1 + (step.cameras >= MANY)], key=lambda matrix: float(np.trace(matrix[PLACE, PLACE]))
    )
    if len(road.group) < SURE_OF_ROAD and not guess.still:
        covariance = UNSURE**2 * covariance
    state = start + solution.x[STATE]
    floor = STILL_FLOOR if guess.still or np.hypot(*state[3:5]) < LEAST_M else FLOOR
    motion = unknowns.covariance(solution.x, covariance) + floor
    seen = seen_points(
        step.second.cameras,
        *((step.pair(term.group)[1], term.rays_b, values(unknowns, term, solution.x)) for term in (fitting, road)),
    )
    nominal = np.linalg.inv(solution.information + np.diag(1 / deviations**2))
    told = float(SLOPE_RAD**2 * (1 / nominal.diagonal()[SLOPES].max() - 1 / deviations[SLOPES].max() ** 2))
    told *= min(float(np.hypot(*state[3:5])) / SHORTEST_M, 1.0) ** 2  # a vehicle that creeps is surer than it may be
    return Candidate(state, motion, votes, len(fitting.group), len(road.group), seen, told)


def _terms(step: StepViews, unknowns: StepUnknowns, residuals: tuple[Residuals, ...], x: Array) -> list[Term]:
    """The residuals with the spread of those of each pair of cameras."""
    return [(term, spread(unknowns, term, x, term.group // PARTS)) for term in residuals if len(term.group)]


def _common(
    step: StepViews, unknowns: StepUnknowns, points: EpipolarResiduals, x: Array, most_px: float
) -> EpipolarResiduals:
    """The points of single cameras, and those of two cameras that see something in common."""
    first, second = step.pair(points.group)
    pairs = first * step.cameras + second
    fits = np.abs(values(unknowns, points, x)[:, 0]) < most_px
    share = np.bincount(pairs, fits, step.cameras**2) / np.maximum(np.bincount(pairs, minlength=step.cameras**2), 1)
    return points.where((first == second) | (fits & (share >= LEAST_SHARE)[pairs]))


def _road(
    step: StepViews, unknowns: StepUnknowns, x: Array, roads: tuple[RoadPicture, RoadPicture], most_m: float
) -> GroundResiduals:
    """The points of the road near the motion of x."""
    motion = unknowns.start + x[STATE]
    yaw = float(motion[2])
    flow = road_flow(*roads, yaw, motion[3:5], most_m)
    rays_a, rays_b, weights = rays_and_weights(flow, (step.first.cameras, step.second.cameras), yaw)
    group = step.group(flow.cameras[:, 0], flow.cameras[:, 1], rays_a)
    return GroundResiduals(group, rays_a, rays_b, weights).sorted()


def _road_in_images(step: StepViews, unknowns: StepUnknowns, x: Array, most_px: float) -> RoadResiduals:
    """The points of the road in the images of single cameras near the motion of x: exact after a short way."""
    geometry = unknowns.geometry(x[unknowns.columns])
    groups, parts = [np.zeros(0, dtype=np.int64)], [NO_POINTS]
    for index, camera in enumerate(step.first.cameras):
        a, b = step.first.images[index], step.second.images[index]
        if a is not None and b is not None:
            group = (index * step.cameras + index) * PARTS
            parts.append(road_points(camera, (a.pixels, b.pixels), geometry, group, most_px, grey=True))
            groups.append(step.group(index, index, parts[-1].rays_a))
    columns = (np.concatenate([getattr(points, field.name) for points in parts]) for field in fields(RoadPoints))
    road = RoadResiduals(np.concatenate(groups), *columns).sorted()
    near = road.beside_m < WAY_M
    return road.where(near) if near.sum() >= FEWEST_OF_ROAD else road  # farther aside may be a pavement: it is higher


def is_measured(candidate: Candidate) -> bool:
    """False where the images do not tell the motion: its deviations are those before anything was measured."""
    turn, position = np.sqrt(np.diag(candidate.covariance)).reshape(2, 3)
    distance = float(np.hypot(*candidate.state[3:5]))
    return bool(np.hypot(*position[:2]) < max(WIDEST_M, WIDEST * distance) and turn.max() < WIDEST_RAD)


NOT_TOLD = "the images do not tell the distance: too few points of the road match"


def reason_of(step: StepViews) -> str:
    """The reason why a step has no candidate."""
    first, second = (sum(image is not None for image in view.images) for view in (step.first, step.second))
    if not min(first, second):
        return "no image shows anything (missing, dark or covered)"
    return "too few points of the images match, or no part of the road looks alike in both frames"
