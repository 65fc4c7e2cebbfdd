"""Two frames between which the vehicle moved: what both images of each camera tell of a reading.

`MatchedPoints` is how far matched points are from where the readings of a rig and of poses put them. `PointsAtOnce` are
those that two cameras see at one time, by which a vehicle that stands tells how they are turned to each other.
`height_above_road` is the height at which the road of both images looks alike: the poses say how far the vehicle moved,
and at any other height the points of the plane road are elsewhere in the second image.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.frame import Drive
from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array, apply, inverse, rigid, rotation_about_z
from bevcli.workshop.correspondence.images import (
    FEWEST_IN_PAIR,
    Features,
    GreyImage,
    correlation,
    features,
    grey_image,
    grey_tiles,
    grid_ahead,
    matched,
    reduced,
    votes,
)
from bevcli.workshop.correspondence.residuals import EpipolarResiduals, GroupGeometry

WIDTH = 800  # pixels of the reduced images
SHORTEST_M, LONGEST_M = 0.7, 12.0  # of a step between two frames
LONGEST_NS = 2_500_000_000
UNSEEN_NS = 400_000_000  # between two frames of a drive without poses
MOST = 4  # pairs of frames
FAR_M = 100.0  # of points on rays; any distance gives their pixels
MOST_PX = 20.0  # a larger residual counts as this
SHORTEST_WAY_M = 0.02  # a shorter way of a camera has no direction
PARALLAX_PX = 2.0  # from which a point tells on which side of the camera it is
AT_ONCE_PX = 3.0  # residual of a point that two cameras see at one time, in the reading that puts it there
ASSUMED_M = 3.0  # way of a vehicle between two frames without poses
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
class CameraPair:
    """Two images of one camera."""

    pair: int  # the index of the pair of frames
    camera: Camera  # of the reduced images
    times_ns: tuple[int, int]  # of the images
    rays_a: Array  # (m, 3) unit directions of matched points in the first image
    rays_b: Array  # (m, 3) of the same points in the second one
    images: tuple[GreyImage, GreyImage]  # grey, reduced


@dataclass(frozen=True)
class _Seen:
    """An image of a frame."""

    time_ns: int
    image: GreyImage
    features: Features


def camera_pairs(drive: Drive, pairs: Sequence[tuple[int, int]]) -> Iterator[CameraPair]:
    """The matched points of pairs of frames (their places in the drive), of each camera that has both images."""
    seen: dict[int, dict[str, _Seen]] = {}
    cameras = [reduced(camera, min(WIDTH, camera.width)) for camera in drive.rig.cameras]
    for number, (first, second) in enumerate(pairs):
        for index in (first, second):
            if index not in seen:
                seen[index] = _seen(drive, index, cameras)
        for camera in cameras:
            a, b = seen[first].get(camera.name), seen[second].get(camera.name)
            if a is not None and b is not None:
                rays_a, rays_b = matched(a.features, b.features, camera, camera)
                if len(rays_a) >= FEWEST_IN_PAIR:
                    times = a.time_ns, b.time_ns
                    yield CameraPair(number, camera, times, rays_a, rays_b, (a.image, b.image))


def _seen(drive: Drive, index: int, cameras: Sequence[Camera]) -> dict[str, _Seen]:
    frame = drive.load(index)
    seen = {}
    for camera in cameras:
        image = frame.images.get(camera.name)
        grey = None if image is None else grey_image(image.pixels_bgr, camera)
        if image is not None and grey is not None:
            seen[camera.name] = _Seen(image.timestamp_ns, grey, features(grey))
    return seen


def moving_pairs(times_ns: NDArray[np.int64], lengths: Array, turns: Array) -> list[tuple[int, int]]:
    """Pairs of successive frames that tell most: those that turn, and others all over the drive.

    Args:
        times_ns: (F,) of the frames.
        lengths: (F,) metres, the way of the vehicle up to each frame.
        turns: (F,) radians, by how much it turned up to each frame.
    """
    possible = []
    for first in range(len(times_ns) - 1):
        later = np.flatnonzero(lengths[first + 1 :] - lengths[first] >= SHORTEST_M)
        second = first + 1 + int(later[0]) if len(later) else 0
        if (
            second
            and lengths[second] - lengths[first] <= LONGEST_M
            and times_ns[second] - times_ns[first] <= LONGEST_NS
        ):
            possible.append((first, second))
    if len(possible) <= MOST:
        return possible
    turning = sorted(possible, key=lambda pair: -abs(turns[pair[1]] - turns[pair[0]]))[: MOST // 2]
    spread = [possible[index] for index in np.linspace(0, len(possible) - 1, MOST - len(turning) + 2)[1:-1].astype(int)]
    return sorted({*turning, *spread})


def timed_pairs(times_ns: NDArray[np.int64]) -> list[tuple[int, int]]:
    """Pairs of frames of a drive without poses, all over it."""
    every = next((step for step in range(1, len(times_ns)) if times_ns[step] - times_ns[0] >= UNSEEN_NS), 1)
    possible = list(pairwise(range(0, len(times_ns), every)))
    return (
        [possible[index] for index in sorted({int(at) for at in np.linspace(0, len(possible) - 1, MOST)})]
        if possible
        else []
    )


class MatchedPoints:
    """The matched points of pairs of images."""

    def __init__(self, pairs: Sequence[CameraPair]) -> None:
        counts = [len(pair.rays_a) for pair in pairs]
        self.pairs = pairs
        self._bounds = np.concatenate([[0], np.cumsum(counts)])
        self._points = EpipolarResiduals(
            np.repeat(np.arange(len(pairs)), counts),
            np.concatenate([pair.rays_a for pair in pairs]),
            np.concatenate([pair.rays_b for pair in pairs]),
            np.repeat([pair.camera.intrinsics[0, 0] for pair in pairs], counts),
        )

    def residual_px(self, ego_from_camera: Array, ego_b_from_ego_a: Array) -> float:
        """The mean of the pairs' median residuals, reduced pixels, each by its number of points: a few may be on a car.

        Arguments: (P, 4, 4), of each pair.
        """
        geometry, medians = GroupGeometry(ego_from_camera, ego_from_camera, ego_b_from_ego_a, np.zeros(2)), []
        off = _off_px(self._points, geometry)
        for start, end in zip(self._bounds, self._bounds[1:], strict=False):
            medians.append(min(float(np.median(off[start:end])), MOST_PX))
        return float(np.average(medians, weights=np.diff(self._bounds)))

    def without_lens(self) -> "MatchedPoints":
        """The same pixels, as if the images had no lens distortion, though their cameras state one."""
        return MatchedPoints([_without_lens(pair) for pair in self.pairs])

    def motions_seen(self, ego_from_camera: Array) -> Array:
        """(P, 4, 4) ego_b_from_ego_a by the images alone: a vehicle that drives along an arc."""
        motions = np.broadcast_to(np.eye(4), (len(self.pairs), 4, 4)).copy()
        for number in {pair.pair for pair in self.pairs}:
            mine = [index for index, pair in enumerate(self.pairs) if pair.pair == number]
            best = max(mine, key=lambda index: len(self.pairs[index].rays_a))
            turn = ego_from_camera[best][:3, :3] @ rotation_seen(self.pairs[best]) @ ego_from_camera[best][:3, :3].T
            yaw = float(np.arctan2(turn[1, 0], turn[0, 0]))
            ways = (rigid(-way * rotation_about_z(yaw / 2)[:, 0], turn) for way in (ASSUMED_M, -ASSUMED_M))
            some = MatchedPoints([self.pairs[index] for index in mine])
            repeated = [np.broadcast_to(way, (len(mine), 4, 4)) for way in ways]
            motions[mine] = min(repeated, key=lambda way: some.residual_px(ego_from_camera[mine], way))
        return motions


class PointsAtOnce:
    """Points in the images of two cameras at one time. A wrong rotation between the cameras fits one by chance only.

    Args:
        drive: its cameras and images.
        frames: their places in the drive.
    """

    def __init__(self, drive: Drive, frames: Sequence[int]) -> None:
        cameras = [reduced(camera, min(WIDTH, camera.width)) for camera in drive.rig.cameras]
        self._names: list[tuple[str, str]] = []
        rays: list[tuple[Array, Array]] = []
        groups, focals = list[int](), list[float]()
        for index in frames:
            seen = _seen(drive, index, cameras)
            for first, second in combinations([camera for camera in cameras if camera.name in seen], 2):
                both = matched(seen[first.name].features, seen[second.name].features, first, second)
                rays.append(both)
                groups += [len(self._names)] * len(both[0])
                focals += [first.intrinsics[0, 0]] * len(both[0])
                self._names.append((first.name, second.name))
        of_a, of_b = (np.concatenate([np.zeros((0, 3)), *(each[side] for each in rays)]) for side in (0, 1))
        self._points = EpipolarResiduals(np.array(groups, np.int64), of_a, of_b, np.array(focals))

    def fitting(self, ego_from_camera: Mapping[str, Array]) -> int:
        """The number of points that lie where cameras with these poses (4, 4) see them."""
        if not self._names:
            return 0
        of_a, of_b = (np.stack([ego_from_camera[names[side]] for names in self._names]) for side in (0, 1))
        stands = np.broadcast_to(np.eye(4), of_a.shape)
        return int((_off_px(self._points, GroupGeometry(of_a, of_b, stands, np.zeros(2))) < AT_ONCE_PX).sum())


def _without_lens(pair: CameraPair) -> CameraPair:
    pinhole = replace(pair.camera, distortion=None)
    rays_a, rays_b = (pinhole.rays(pair.camera.project(FAR_M * rays)[0]) for rays in (pair.rays_a, pair.rays_b))
    return replace(pair, rays_a=rays_a, rays_b=rays_b)


def _off_px(points: EpipolarResiduals, geometry: GroupGeometry) -> Array:
    """(N,) pixels that points are off; those behind a camera, or of cameras at one place, by their whole parallax."""
    off = np.abs(points.of(geometry)[:, 0])
    relative = geometry.camera_b_from_camera_a[points.group]
    turned = np.einsum("nij,nj->ni", relative[:, :3, :3], points.rays_a)
    parallax = points.focal * np.linalg.norm(np.cross(turned, points.rays_b), axis=-1)
    behind = (points.depths(geometry) < 0).any(-1) & (parallax > PARALLAX_PX)
    stays = np.linalg.norm(relative[:, :3, 3], axis=-1) < SHORTEST_WAY_M
    return np.where(behind | stays | ((turned * points.rays_b).sum(-1) < 0), np.maximum(off, parallax), off)


def rotation_seen(pair: CameraPair) -> Array:
    """(3, 3) camera_b_from_camera_a by the matched points."""
    flat_a, flat_b = (rays[:, :2] / rays[:, 2:] for rays in (pair.rays_a, pair.rays_b))
    threshold = 1 / pair.camera.intrinsics[0, 0]
    essential, inliers = cv2.findEssentialMat(flat_a, flat_b, np.eye(3), cv2.RANSAC, 0.999, threshold)
    if essential is None or essential.shape != (3, 3):
        return np.eye(3)
    _, rotation, _, _ = cv2.recoverPose(essential, flat_a, flat_b, np.eye(3), mask=inliers)
    return np.asarray(rotation, dtype=np.float64)


def body_motions(poses: Array) -> Array:
    """(P, 4, 4) body_b_from_body_a of poses (P, 2, 4, 4), world_from_body at the times of both images."""
    return inverse(poses[:, 1]) @ poses[:, 0]


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
