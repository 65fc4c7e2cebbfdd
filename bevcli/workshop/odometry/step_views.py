"""Two frames: the points matched in both, and the unknowns of the step between them.

The unknowns are the motion of the vehicle, the slope of the road, and the height of the cameras over it. The motion
along a part of a step is the exponential of that part of its twist.
"""

from collections.abc import Callable, Sequence as Items
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bevcli.frame import Frame
from bevcli.geometry.cameras import OUTSIDE, Camera, CameraRig
from bevcli.geometry.transforms import Array, inverse, rigid
from bevcli.workshop.correspondence.images import (
    Features,
    GreyImage,
    contrast,
    features,
    flow_at,
    grey_image,
    matched,
    neighbours,
    reduced,
    sampled,
    texture,
)
from bevcli.workshop.correspondence.residuals import (
    EpipolarResiduals,
    GroupGeometry,
    Indices,
    Residuals,
    rays_of_road_points,
)

CELL_M = 0.08
BEGIN_M, SHAPE = (-24.0, -9.0), (225, 640)  # the smallest x and y; cells along y and x
SLOPE_STEP, KEPT = np.radians(0.25), 3  # of grids, of which the last ones are kept
MOST_BLUR_M = 0.45  # of the road in one pixel, along the ray
MARGIN = 9  # cells, between cameras


@dataclass(frozen=True)
class RoadPicture:
    """The road around the vehicle in the ego frame; rows along y, columns along x."""

    texture: NDArray[np.uint8]  # (225, 640), 128 where nothing is seen
    seen: NDArray[np.bool_]  # (225, 640)
    of: NDArray[np.int8]  # (225, 640) the camera of each cell, -1 for none
    slopes: Array  # (2,) of the road along x and y


def nearest_cameras(cameras: Items[Camera], points: Array) -> tuple[list[NDArray[np.float32]], NDArray[np.int8], Array]:
    """The cameras that see points (H, W, 3) of the road sharply, ego frame.

    Returns the pixels (H, W, 2) of the points in each camera; the index (H, W) of the nearest one that sees them, -1
    where none does; and the distance (H, W) to it.
    """
    maps, distances = [], []
    for camera in cameras:
        pixels, depth = camera.project_ego(points)
        away = np.linalg.norm(points - camera.ego_from_camera[:3, 3], axis=-1)
        blur = away**2 / max(camera.ego_from_camera[2, 3] * camera.intrinsics[0, 0], 1e-3)
        usable = camera.contains(pixels, depth) & (blur < MOST_BLUR_M)
        distances.append(np.where(usable, away, np.inf))
        maps.append(np.nan_to_num(pixels, nan=OUTSIDE).astype(np.float32))
    nearest, distance = np.argmin(distances, axis=0), np.min(distances, axis=0)
    return maps, np.where(np.isinf(distance), -1, nearest).astype(np.int8), distance


class RoadGrid:
    """The cells of a road picture, of a road with slopes along x and y of the ego frame, in the images of a rig."""

    def __init__(self, cameras: Items[Camera], slope_x: float, slope_y: float) -> None:
        self._slopes = np.array([slope_x, slope_y])
        rows, columns = np.indices(SHAPE)
        x, y = BEGIN_M[0] + CELL_M * columns, BEGIN_M[1] + CELL_M * rows
        points = np.stack([x, y, slope_x * x + slope_y * y], axis=-1)
        self._maps, self._of, _ = nearest_cameras(cameras, points)

    def picture(self, images: Items[GreyImage | None]) -> RoadPicture:
        """The road in the images of a frame."""
        grey, seen = np.zeros(SHAPE, dtype=np.float32), np.zeros(SHAPE, dtype=bool)
        for index, (image, pixels) in enumerate(zip(images, self._maps, strict=True)):
            mine = self._of == index
            if image is None or not mine.any():
                continue
            grey[mine] = sampled(image.pixels, pixels)[mine]
            seen |= cv2.erode(mine.astype(np.uint8), np.ones((MARGIN, MARGIN))) > 0
        return RoadPicture(texture(grey, seen), seen, self._of, self._slopes)


def moved_picture(picture: RoadPicture, yaw: float, shift: Array) -> RoadPicture:
    """The picture in a frame; its points are turned by a yaw and then shifted (2,) to be those of the picture's."""
    c, s = np.cos(yaw), np.sin(yaw)
    turn, begin = np.array([[c, -s], [s, c]]), np.array(BEGIN_M)
    matrix = np.column_stack([turn, (turn @ begin + shift - begin) / CELL_M])
    size, inverse = SHAPE[::-1], cv2.WARP_INVERSE_MAP
    grey = cv2.warpAffine(picture.texture, matrix, size, flags=inverse | cv2.INTER_LINEAR, borderValue=128)
    seen = cv2.warpAffine(picture.seen.astype(np.uint8), matrix, size, flags=inverse | cv2.INTER_NEAREST)
    return replace(picture, texture=np.asarray(grey, dtype=np.uint8), seen=seen > 0)


PIXELS, WIDEST = 1.8e6, 1250  # of all reduced images of a frame together, and the width of one


@dataclass(frozen=True)
class FrameView:
    """The views of one frame."""

    timestamp_ns: int
    cameras: tuple[Camera, ...]  # of the reduced images
    late_s: Array  # (C,) when each image was taken, after the frame's time
    images: tuple[GreyImage | None, ...]  # None: no image, or one that shows nothing
    features: tuple[Features | None, ...]
    grid: Callable[[float, float], RoadGrid]  # of a road with these slopes

    def road(self, slopes: Array) -> RoadPicture:
        """The road seen from above, of slopes (2,) in the ego frame, rounded to steps of SLOPE_STEP."""
        x, y = (float(round(slope / SLOPE_STEP) * SLOPE_STEP) for slope in slopes)
        return self.grid(x, y).picture(self.images)


class Viewer:
    """Makes the views of frames. What depends on the rig alone is kept."""

    def __init__(self) -> None:
        self._rig: CameraRig | None = None

    def view(self, frame: Frame) -> FrameView:
        """The views of a frame."""
        if frame.rig is not self._rig:
            self._rig, self._cameras = frame.rig, _reduced(frame.rig)
            self._grid = lru_cache(maxsize=KEPT)(partial(RoadGrid, self._cameras))
        time, cameras = frame.stamp.timestamp_ns, self._cameras
        shown = [frame.images.get(camera.name) for camera in cameras]
        taken = [time if image is None else image.timestamp_ns for image in shown]
        images = tuple(
            None if image is None else grey_image(image.pixels_bgr, camera)
            for image, camera in zip(shown, cameras, strict=True)
        )
        described = tuple(None if image is None else features(image) for image in images)
        return FrameView(time, cameras, (np.array(taken) - time) / 1e9, images, described, self._grid)


def _reduced(rig: CameraRig) -> tuple[Camera, ...]:
    """The cameras of the reduced images."""
    wide = sum(camera.height / camera.width for camera in rig.cameras)  # pixels of all for a width of one pixel
    width = min(WIDEST, int(np.sqrt(PIXELS / wide)))
    return tuple(reduced(camera, min(width, camera.width)) for camera in rig.cameras)


TURN, PLACE, SLOPES, HEIGHT = slice(0, 3), slice(3, 6), slice(6, 8), 8  # the indices of the unknowns
COUNT = 9
STATE = slice(0, 8)  # those that a start has
# Of pitch and roll, and of the height (and as a share of the way), between two frames.
SUSPENSION_RAD, SUSPENSION_M = np.radians(0.7), (0.01, 0.01)
YAW_RAD, ALONG = np.radians(3.0), 0.3  # by which the start may be wrong, the second as a share of the distance
SHORTEST_M = 0.5  # distance for that share
SLOPE_RAD, CHANGE_RAD = np.radians(0.5), np.radians(0.2)  # of the road under the vehicle, and its change in a step
SMALLEST_RAD = 1e-7  # radians; below it an arc is a line


@dataclass(frozen=True)
class StepUnknowns:
    """The unknowns x (9,) of a step, counted from a start.

    x holds the rotation vector of ego_a_from_ego_b (radians); the way along x and y, and the change of the height over
    the road (metres); the slopes of the road along x and y; the error of the stated heights of all cameras (metres).
    So the vehicle drives along the road, whose slope in the ego frame is also the pitch of the vehicle over it.
    """

    sides: tuple[Array, Array]  # (G, 4, 4) ego_from_camera of both images of a group
    shares: Array  # (G, 2) when they were taken, as shares of the step: 0 is the first frame's time, 1 the second's
    start: Array  # (8,) of all but the last
    deviations: Array  # (9,)

    @cached_property
    def columns(self) -> Indices:
        """(G, 9): each group depends on all unknowns."""
        return np.tile(np.arange(COUNT), (len(self.shares), 1))

    @cached_property
    def _times(self) -> tuple[Array, Indices]:
        """The shares that occur, (T,), and which of them both images of each group have, (G, 2)."""
        times, of_group = np.unique(self.shares, return_inverse=True)
        return times, of_group.reshape(self.shares.shape)

    def geometry(self, local: Array) -> GroupGeometry:
        """The geometry of all groups."""
        x, (times, of_group) = local[0], self._times
        motion = self.motion(x)
        if set(times.tolist()) <= {0.0, 1.0}:
            poses = np.where(times[:, None, None] > 0, motion, np.eye(4))
        else:
            poses = exponential(times[:, None] * logarithm(motion))  # in the first ego frame
        between = inverse(poses)[:, None] @ poses  # (T, T, 4, 4)
        raised = rigid((0, 0, x[HEIGHT]))
        a, b = (raised @ side for side in self.sides)
        return GroupGeometry(a, b, between[of_group[:, 1], of_group[:, 0]], self.start[SLOPES] + x[SLOPES])

    def motion(self, x: Array) -> Array:
        """(4, 4) ego_a_from_ego_b."""
        return motion_of(self.start + x[STATE])

    def covariance(self, x: Array, covariance: Array) -> Array:
        """(6, 6) of rotation and translation, of the covariance (9, 9) of x."""
        slopes, way = self.start[SLOPES] + x[SLOPES], (self.start + x[STATE])[PLACE][:2]
        derivative = np.eye(6, COUNT)
        derivative[5, 3:5], derivative[5, SLOPES] = slopes, way
        return np.asarray(derivative @ covariance @ derivative.T)


def motion_of(state: Array) -> Array:
    """(4, 4) ego_a_from_ego_b of a state (8,): see `StepUnknowns`."""
    x, y, over = state[PLACE]
    climb = state[SLOPES] @ (x, y)
    return rigid((x, y, over + climb), Rotation.from_rotvec(state[TURN]).as_matrix())


def next_slopes(state: Array) -> Array:
    """(2,) the slopes of the road in the second ego frame."""
    normal = Rotation.from_rotvec(state[TURN]).inv().apply(np.array([*-state[SLOPES], 1.0]))
    return np.asarray(-normal[:2] / normal[2])


def deviations_at(start: Array, height_m: float, slope_rad: float, *, known_distance: bool = False) -> Array:
    """(9,) the standard deviations of the unknowns about a start (8,).

    known_distance: hold the distance of the start, and let the direction be anything.
    """
    wide = max(float(np.hypot(*start[3:5])), SHORTEST_M) * ALONG
    over = SUSPENSION_M[0] + SUSPENSION_M[1] * float(np.hypot(*start[3:5]))
    along = 1e-3 if known_distance else wide
    return np.array([SUSPENSION_RAD, SUSPENSION_RAD, YAW_RAD, along, wide, over, slope_rad, slope_rad, height_m])


def _along(turn: Array) -> Array:
    """(..., 3, 3) from the velocity of a unit of time to the translation of an arc with a turn (..., 3)."""
    angle = np.linalg.norm(turn, axis=-1)[..., None, None]
    skew = np.cross(turn[..., None, :], np.eye(3)).swapaxes(-1, -2)  # (..., 3, 3) of the cross product
    safe = np.maximum(angle, SMALLEST_RAD)
    first = np.where(angle < SMALLEST_RAD, 0.5, (1 - np.cos(safe)) / safe**2)
    second = np.where(angle < SMALLEST_RAD, 0.0, (safe - np.sin(safe)) / safe**3)
    return np.asarray(np.eye(3) + first * skew + second * skew @ skew)


def exponential(twist: Array) -> Array:
    """(..., 4, 4) the motions of twists (..., 6): rotation vector (radians) and velocity (metres) of a unit of time."""
    motion = np.zeros((*twist.shape[:-1], 4, 4))
    turns = Rotation.from_rotvec(twist[..., :3].reshape(-1, 3))
    motion[..., :3, :3] = turns.as_matrix().reshape(*twist.shape[:-1], 3, 3)
    motion[..., :3, 3] = (_along(twist[..., :3]) @ twist[..., 3:, None])[..., 0]
    motion[..., 3, 3] = 1
    return motion


def logarithm(motion: Array) -> Array:
    """(6,) the twist of a motion (4, 4): its inverse."""
    turn = Rotation.from_matrix(motion[:3, :3]).as_rotvec()
    return np.concatenate([turn, np.linalg.solve(_along(turn), motion[:3, 3])])


PARTS = 6  # of a pair of images, whose agreement tells the deviations


@dataclass(frozen=True)
class StepViews:
    """Two frames of C cameras. Their images form C x C groups, and each group has PARTS."""

    first: FrameView
    second: FrameView

    @property
    def cameras(self) -> int:
        """Number of cameras."""
        return len(self.first.cameras)

    @property
    def seconds(self) -> float:
        """Between the frames."""
        return (self.second.timestamp_ns - self.first.timestamp_ns) / 1e9

    def pair(self, group: Indices) -> tuple[Indices, Indices]:
        """The cameras of the first and of the second images of groups."""
        return np.divmod(group // PARTS, self.cameras)

    def group(self, first: Indices | int, second: Indices | int, rays_a: Array) -> Indices:
        """(n,) the groups of points with rays (n, 3) in images of a first and of a second camera."""
        sector = np.digitize(rays_a[:, 0], (-0.25, 0.25)) + 3 * (rays_a[:, 1] > 0.1)
        return np.asarray((first * self.cameras + second) * PARTS + sector, dtype=np.int64)

    def of_single_cameras(self, points: EpipolarResiduals) -> EpipolarResiduals:
        """The points whose images are of the same camera."""
        return points.where(np.equal(*self.pair(points.group)))

    def geometry(self, state: Array) -> GroupGeometry:
        """The geometry of all groups for a state (8,)."""
        unknowns = self.unknowns(state, np.ones(COUNT))
        return unknowns.geometry(np.zeros((len(unknowns.shares), COUNT)))

    def unknowns(self, start: Array, deviations: Array) -> StepUnknowns:
        """The unknowns about a start (8,)."""
        groups = self.pair(np.arange(self.cameras**2 * PARTS))
        sides = list(zip((self.first, self.second), groups, strict=True))
        a, b = (np.stack([camera.ego_from_camera for camera in view.cameras])[index] for view, index in sides)
        shares = [side + view.late_s[index] / self.seconds for side, (view, index) in enumerate(sides)]
        return StepUnknowns((a, b), np.stack(shares, -1), start, deviations)


def match_points(step: StepViews) -> EpipolarResiduals:
    """The matched points of each camera with itself and with its neighbours."""
    nothing = np.zeros((0, 3))
    parts = [(np.zeros(0, dtype=np.int64), nothing, nothing, np.zeros(0))]
    for i, j in [(index, index) for index in range(step.cameras)] + neighbours(step.first.cameras):
        first, second = step.first.features[i], step.second.features[j]
        if first is None or second is None:
            continue
        rays_a, rays_b = matched(first, second, step.first.cameras[i], step.second.cameras[j])
        focal = np.full(len(rays_a), step.first.cameras[i].intrinsics[0, 0])
        parts.append((step.group(i, j, rays_a), rays_a, rays_b, focal))
    return EpipolarResiduals(*map(np.concatenate, zip(*parts, strict=True))).sorted()


@dataclass(frozen=True)
class StillPoints(EpipolarResiduals):
    """Points that stay where they are in the image: they tell the rotation, since there is no direction of driving."""

    def of(self, geometry: GroupGeometry) -> Array:
        """(N, 3) pixels."""
        turns = geometry.camera_b_from_camera_a[self.group, :3, :3]
        return self.focal[:, None] * (np.einsum("nij,nj->ni", turns, self.rays_a) - self.rays_b)


def still_points(step: StepViews, points: EpipolarResiduals) -> StillPoints:
    """The points of single cameras."""
    inside = step.of_single_cameras(points)
    return StillPoints(inside.group, inside.rays_a, inside.rays_b, inside.focal)


SPACING, WINDOW = 8, 21  # cells: between points of the flow, and the side of what is compared
PIXEL = 0.5  # standard deviation of a direction, pixels
FLOW_M = 0.01  # of the flow


@dataclass(frozen=True)
class RoadFlow:
    """Points of the road in two pictures."""

    first: Array  # (n, 3) in the first ego frame, metres
    second: Array  # (n, 3) in the second one
    contrast: Array  # (n, 2, 2) symmetric: 0 to 1 along each axis of the contrast, in the first ego frame
    cameras: Indices  # (n, 2) that see them


def road_flow(first: RoadPicture, second: RoadPicture, yaw: float, shift: Array, most_m: float) -> RoadFlow:
    """Points of the road, at most `most_m` from where a motion puts them: a yaw and a shift (2,), ego_a_from_ego_b."""
    c, s = np.cos(yaw), np.sin(yaw)
    back = np.array([[c, s], [-s, c]])  # from the first frame to the second one, about the shift
    warped = moved_picture(second, -yaw, -back @ shift)
    both = cv2.erode((first.seen & warped.seen).astype(np.uint8), np.ones((WINDOW, WINDOW)))
    at = np.argwhere(both[::SPACING, ::SPACING] > 0)[:, ::-1].astype(np.float32) * SPACING
    if not len(at):
        return RoadFlow(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 2, 2)), np.zeros((0, 2), dtype=np.int64))
    flow, kept = flow_at(first.texture, warped.texture, at)
    kept &= np.linalg.norm(flow, axis=-1) * CELL_M < most_m
    at, flow = at[kept], flow[kept]
    points, moved = BEGIN_M + CELL_M * at, BEGIN_M + CELL_M * (at + flow)
    there = (moved - shift) @ back.T
    columns, rows = np.rint((there - BEGIN_M) / CELL_M).astype(int).T
    cameras = [first.of[at[:, 1].astype(int), at[:, 0].astype(int)],
               second.of[rows.clip(0, SHAPE[0] - 1), columns.clip(0, SHAPE[1] - 1)]]  # fmt: skip
    seen = np.minimum(*cameras) >= 0
    told = contrast(first.texture, at)
    points, there = (np.column_stack([xy, xy @ of.slopes]) for xy, of in ((points, first), (there, second)))
    return RoadFlow(points[seen], there[seen], told[seen], np.stack(cameras, -1)[seen].astype(np.int64))


@dataclass(frozen=True)
class GroundResiduals(Residuals):
    """The distance of road points from where they would be on a plane road, in standard deviations.

    The weights turn an error of a ray in the second image into metres on the road, divided by their deviation.
    """

    weights: Array  # (N, 2, 3)

    def of(self, geometry: GroupGeometry) -> Array:
        """(N, 2)."""
        ahead = rays_of_road_points(geometry, geometry.ego_from_camera_b, self.group, self.rays_a)
        return np.einsum("nij,nj->ni", self.weights, ahead - self.rays_b)


def rays_and_weights(
    flow: RoadFlow, cameras: tuple[tuple[Camera, ...], tuple[Camera, ...]], yaw: float
) -> tuple[Array, Array, Array]:
    """Rays (n, 3) of the points in the first and in the second images, and the weights (n, 2, 3).

    cameras: of the first and of the second frame. yaw: by which the vehicle turned.
    """
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    (rays_a, spread_a, _), (rays_b, spread_b, to_road) = (
        _seen(points, np.array([camera.ego_from_camera for camera in of])[index],
              np.array([camera.intrinsics[0, 0] for camera in of])[index])
        for points, of, index in zip((flow.first, flow.second), cameras, flow.cameras.T, strict=True)
    )  # fmt: skip
    covariance = spread_a + turn @ spread_b @ turn.T + FLOW_M**2 * np.eye(2)
    size, axes = np.linalg.eigh(covariance)
    whitening = np.einsum("nij,nj,nkj->nik", axes, size**-0.5, axes)
    return rays_a, rays_b, flow.contrast @ whitening @ turn @ to_road


def _seen(points: Array, pose: Array, focal: Array) -> tuple[Array, Array, Array]:
    """How cameras with poses (n, 4, 4) and focal lengths (n,) see points (n, 3) of the road.

    Returns rays (n, 3) in the camera frame, the covariance (n, 2, 2) of a point by the error of a pixel, metres², and
    the derivative (n, 2, 3) of the point by the ray.
    """
    away = points - pose[:, :3, 3]
    length = np.linalg.norm(away, axis=-1, keepdims=True)
    direction = away / length
    slope = np.zeros((len(points), 2, 3))
    slope[:, 0, 0] = slope[:, 1, 1] = 1
    slope[:, :, 2] = -direction[:, :2] / direction[:, 2:]
    slope *= length[:, :, None]
    covariance = (PIXEL / focal)[:, None, None] ** 2 * slope @ slope.swapaxes(1, 2)
    return np.einsum("nji,nj->ni", pose[:, :3, :3], direction), covariance, slope @ pose[:, :3, :3]
