"""How far the vehicle drove, by matched points: each tells the way with which it lies on the road, or it stays.

Points of the road agree. Higher ones tell a longer way, and vehicles ahead a shorter one. Drops on a lens tell nothing:
they have no matches that move. So these votes hold where the road from above shows drops, or a bonnet.
"""

import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.transforms import Array
from bevcli.workshop.correspondence.residuals import EpipolarResiduals, GroupGeometry

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
