"""Matched points that stay where they are in the image, of a vehicle that stands."""

import numpy as np

from bevcli.geometry.transforms import Array
from bevcli.workshop.correspondence.residuals import EpipolarResiduals

STILL_PX, STILL_SHARE = 0.35, 0.85  # of matched points of a vehicle that stands
NEAR_DOWN, FEWEST_NEAR = 0.08, 8  # sine of the angle below the horizon of near points, and how many tell something
FEWEST = 30  # matched points that tell whether a vehicle stands


def stands(points: EpipolarResiduals, ego_from_camera: Array) -> bool:
    """True where most matched points of single cameras stay in the image, and half of those near the vehicle.

    Far points stay also where the vehicle creeps. ego_from_camera: (N, 4, 4) of each point.
    """
    moved_px = np.linalg.norm(points.rays_a - points.rays_b, axis=-1) * points.focal
    near = -np.einsum("nj,nj->n", ego_from_camera[:, 2, :3], points.rays_a) > NEAR_DOWN
    if len(moved_px) < FEWEST or (moved_px < STILL_PX).mean() < STILL_SHARE:
        return False
    return bool(near.sum() < FEWEST_NEAR or np.median(moved_px[near]) < STILL_PX)
