"""How high the cameras are above the road: the height at which the road of two images looks alike.

The poses say how far the vehicle moved. The road is a plane that the images of a camera show twice; at any other height
its points in the second image are elsewhere.
"""

from dataclasses import dataclass

import numpy as np

from bevcli.geometry.transforms import Array, apply, inverse
from bevcli.workshop.correspondence.road import correlation, grey_tiles, grid_ahead, votes
from bevcli.workshop.readings.pairs import CameraPair
from bevcli.workshop.readings.residuals import MatchedPoints

HEIGHTS_M = 0.35, 4.5  # of a camera above the road
RATIO = 1.02  # of two heights that are tried
COUNT = int(np.log(HEIGHTS_M[1] / HEIGHTS_M[0]) / np.log(RATIO))
LOOKS_ALONG = 0.8  # cosine of the largest angle between a camera's direction and the way: others see little road twice
LEAST_M = 1.0  # the shortest way
SEEN_FROM_M = 1.5  # height of the cameras for the choice of pixels
NOTHING = 0.2  # of the votes of a tile, less of which is chance
LEAST_VOTES, CLEAR = 0.8, 1.6  # votes of a tile at the best height; and times those of other heights
APART = 0.12  # other heights differ by more than this share


@dataclass(frozen=True)
class HeightSeen:
    """The mean height of cameras above the road, and how clear it is."""

    height_m: float  # metres
    clearness: float  # the votes for it by those for any other height
    tiles: int  # of the road, that voted


def height_above_road(points: MatchedPoints, cameras: Array, steps: Array) -> HeightSeen | None:
    """The mean height of the cameras (P, 4, 4), ego_from_camera, by steps (P, 4, 4), ego_b_from_ego_a.

    None where no camera sees the road twice.
    """
    pairs, level = points.pairs, steps.copy()
    level[:, 2, 3] = 0  # some poses have all positions at one height, though the vehicle pitches
    if points.residual_px(cameras, level) <= points.residual_px(cameras, steps):
        steps = level
    mean = float(np.mean(cameras[:, 2, 3]))
    heights = np.asarray(HEIGHTS_M[0] * RATIO ** np.arange(COUNT), dtype=np.float64)
    summed, tiles = np.zeros(len(heights)), 0
    for pair, camera, step in zip(pairs, cameras, steps, strict=True):
        if np.linalg.norm(step[:3, 3]) >= LEAST_M and abs(camera[0, 2]) >= LOOKS_ALONG:
            told = _votes(pair, camera, step, heights - mean)
            summed, tiles = summed + told.sum(1), tiles + int((told.max(0) > LEAST_VOTES).sum())
    if not tiles:
        return None
    best = int(summed.argmax())
    others = np.abs(np.log(heights / heights[best])) > APART
    return HeightSeen(_top(heights, summed, best), float(summed[best] / max(summed[others].max(), 1e-9)), tiles)


def _votes(pair: CameraPair, ego_from_camera: Array, step: Array, raised: Array) -> Array:
    """(H, tiles) how much tiles of the road look alike in both images, beyond what they do at most heights.

    raised: (H,) metres that the cameras are higher than stated. The road leads along the way.
    """
    level = ego_from_camera.copy()
    level[2, 3] = SEEN_FROM_M
    rays = (grid_ahead(level) - level[:3, 3]) @ ego_from_camera[:3, :3]  # of the same pixels at all heights
    first = grey_tiles(pair.camera, pair.images[0].pixels, rays)
    normal = np.array([-step[2, 3] / step[0, 3], 0.0, 1.0])
    along, start = rays @ ego_from_camera[:3, :3].T, ego_from_camera[:3, 3]
    camera_from_ego, told = inverse(ego_from_camera), []
    for height in raised:
        depth = -(start @ normal + height) / np.minimum(along @ normal, -1e-3)
        road = apply(camera_from_ego @ step, start + depth[..., None] * along)
        told.append(votes(np.maximum(correlation(first, grey_tiles(pair.camera, pair.images[1].pixels, road)), 0)))
    return np.maximum(np.stack(told) - np.median(told, axis=0) - NOTHING, 0)


def _top(heights: Array, summed: Array, best: int) -> float:
    """The height between those that were tried, by a parabola."""
    if not 0 < best < len(heights) - 1:
        return float(heights[best])
    before, here, after = summed[best - 1 : best + 2]
    shift = 0.5 * (before - after) / min(before - 2 * here + after, -1e-9)
    return float(heights[best] * RATIO**shift)
