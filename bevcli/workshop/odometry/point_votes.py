"""How far the vehicle drove, by matched points: each tells the way with which it lies on the road.

Points of the road agree. Higher ones tell a longer way, and vehicles ahead a shorter one. Drops on a lens tell nothing:
they have no matches that move. So these votes hold where the road from above shows drops, or a bonnet.
"""

import numpy as np

from bevcli.geometry.transforms import Array
from bevcli.workshop.correspondence.residuals import EpipolarResiduals, GroupGeometry

LEAST_PX = 1.5  # of the way in the image that is due to driving, without the turn
LEAST_DOWN = 0.03  # sine of the angle below the horizon
FEWEST = 15  # points
WIDTH = 0.12  # deviation of the logarithm of a point's way
CHANCE = 0.15  # of the votes that a distance has without such a point


def ways_of_points(points: EpipolarResiduals, geometry: GroupGeometry, length: float) -> Array:
    """(n,) metres: the ways with which points of single cameras, those below the horizon, lie on the road.

    length: way of the motion of the geometry.
    """
    relative, pose = geometry.camera_b_from_camera_a[points.group], geometry.ego_from_camera_a[points.group]
    turned = np.einsum("nij,nj->ni", relative[:, :3, :3], points.rays_a)
    moved_px = np.linalg.norm(np.cross(turned, points.rays_b), axis=-1) * points.focal
    normal = np.array([*-geometry.slopes, 1.0])
    down = -np.einsum("nij,nj->ni", pose[:, :3, :3], points.rays_a) @ normal
    depths = points.depths(geometry)
    kept = (moved_px > LEAST_PX) & (down > LEAST_DOWN) & (np.prod(np.sign(depths), axis=-1) > 0)
    road = (pose[kept, :3, 3] @ normal) / down[kept]
    return np.asarray(length * road / np.abs(depths[kept, 0]))


def point_votes(ways: Array, distances: Array) -> Array:
    """(D,) factors up to 1, of the votes of the road for distances (D,): the share of the points that agree."""
    if len(ways) < FEWEST:
        return np.ones(len(distances))
    logarithms = np.log(np.maximum(np.abs(distances), 1e-3))
    apart = (np.log(ways)[:, None] - logarithms) / WIDTH
    shares = np.exp(-(apart**2) / 2).mean(0)
    return np.asarray(CHANCE + (1 - CHANCE) * shares / max(float(shares.max()), 1e-9))
