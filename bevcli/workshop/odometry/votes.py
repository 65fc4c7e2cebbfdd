"""How far the vehicle drove between two frames: the votes of tiles of the road, and those of matched points.

Tiles of the first road picture are compared with the second one at all distances along the way; those that look alike
vote. Each matched point tells the way with which it lies on the road, or it stays. Points of the road agree. Higher
ones tell a longer way, and vehicles ahead a shorter one. Drops on a lens tell nothing: they have no matches that move.
So the votes of points hold where the road from above shows drops, or a bonnet.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.transforms import Array
from bevcli.workshop.correspondence.residuals import EpipolarResiduals, GroupGeometry
from bevcli.workshop.odometry.views import BEGIN_M, CELL_M, SHAPE, RoadPicture, moved_picture

TILE, ASIDE = 25, 2  # cells: side of a tile, and by how much it may lie beside the way
LEAST_SEEN, LEAST_CONTRAST = 0.8, 8.0  # of a tile: share, and grey levels of standard deviation
NOTHING, MOST = 0.15, 2.0  # of the vote of a tile, less of which is chance, and which is the largest
WAY_M = 5.0  # tiles farther beside the vehicle count less: they are less often road


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
            weights.append(np.exp(-((beside / WAY_M) ** 2)))
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
FEWEST, FEWEST_FOR_ALL = 15, 30  # points that vote for a way, and that tell which of them drive by themselves
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
    if len(told) < FEWEST:
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
