"""The frame pairs of a drive that are used, the grey images of their frames, and the points that are matched in both.

Points are matched by SIFT features; what moves by itself is left out.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bevcli.errors import InputError
from bevcli.frame import Frame, Sequence
from bevcli.geometry.cameras import Camera, CameraRig
from bevcli.geometry.ego_motion import EgoMotion, motion_during
from bevcli.geometry.transforms import Array
from bevcli.workshop.calibration import CalibrateOptions
from bevcli.workshop.calibration.adjustment import DELAYS_S, OF_PAIR, EpipolarResiduals, Unknowns

WIDTH, MOST_ENLARGED = 1000, 2  # pixels: all images are brought to this width; largest factor
NEAREST_M, FARTHEST_M = 0.8, 12.0  # distance driven between the frames of a pair
MOST_FRAMES = 120  # that are read where the poses of the drive are known only with its images
FEWEST_PAIRS = 6  # a measurement from fewer would be sure of an error of the poses
THREADS = min(os.cpu_count() or 1, 8)  # each needs about 150 MB while it finds features
READING_STEPS = 10  # of progress
DARKEST = 4  # grey levels of standard deviation; an image with less shows nothing
SMOOTHING, COARSE = 1.2, 35  # pixels: finer structure is noise, coarser is light and shade
FLAT = 1.0  # grey levels, a weaker structure is noise


@dataclass(frozen=True)
class View:
    """One camera's image at one time."""

    pixels: NDArray[np.uint8]  # (h, w) grey, at most WIDTH wide
    texture: NDArray[np.uint8]  # (h, w) fine structure with even contrast, without light and shade
    poses: Array  # (25, 4, 4) world_from_ego when it was taken, and each of DELAYS_S later


@dataclass(frozen=True)
class Views:
    """What a drive shows."""

    stated: CameraRig  # the rig of the frames
    rig: CameraRig  # the same with cameras for the reduced images
    pairs: tuple[tuple[int, int], ...]  # indices of the frames of each pair
    of: dict[tuple[int, int], View]  # (frame index, camera index) -> view; missing images are left out

    def groups(self) -> list[tuple[int, int, int]]:
        """(pair, camera of its first frame, camera of its second one): each camera with itself and its neighbours."""
        cameras = [(index, index) for index in range(len(self.rig.cameras))] + self.neighbours()
        return [
            (pair, first, second)
            for pair, (a, b) in enumerate(self.pairs)
            for first, second in cameras
            if (a, first) in self.of and (b, second) in self.of
        ]

    def neighbours(self) -> list[tuple[int, int]]:
        """Each camera with the next ones to the left and to the right."""
        around = np.argsort([camera.yaw for camera in self.rig.cameras]).tolist()
        pairs = {(a, b) for a, b in zip(around, around[1:] + around[:1], strict=True) if a != b}
        return sorted(pairs | {(b, a) for a, b in pairs})

    def sides(self, group: tuple[int, int, int]) -> tuple[View, View]:
        """The two views of a group."""
        (a, b), (_, first, second) = self.pairs[group[0]], group
        return self.of[a, first], self.of[b, second]


def read_views(drive: Sequence, most_pairs: int, progress: Callable[[], None] = lambda: None) -> Views:
    """The views of a drive. progress: called READING_STEPS times.

    Raises InputError where the drive does not show how its cameras move.
    """
    _check(drive)
    pairs = _choose_pairs(_positions(drive), most_pairs)
    if len(pairs) < FEWEST_PAIRS:
        raise InputError(
            f"{drive.name}: the vehicle moves between {len(pairs)} pairs of frames by {NEAREST_M:g} to {FARTHEST_M:g} "
            f"m (expected {FEWEST_PAIRS} or more): choose more frames, or a part of the drive in which it moves"
        )
    views: dict[tuple[int, int], View] = {}
    frames = sorted({frame_index for pair in pairs for frame_index in pair})
    for done, frame_index in enumerate(frames, 1):
        frame = drive.load(frame_index)
        if done == 1:
            stated, rig = frame.rig, replace(frame.rig, cameras=tuple(map(_reduced, frame.rig.cameras)))
        for index, camera in enumerate(rig.cameras):
            view = _view(frame, camera, drive.ego_motion)
            if view is not None:
                views[frame_index, index] = view
        for _ in range(READING_STEPS * done // len(frames) - READING_STEPS * (done - 1) // len(frames)):
            progress()
    if not views:
        raise InputError(f"{drive.name}: no image shows anything (expected images with contrast, not black ones)")
    return Views(stated, rig, tuple(pairs), views)


def _check(drive: Sequence) -> None:
    if not drive.has_ego_motion:
        raise InputError(
            f"{drive.name}: has no ego-motion (expected the vehicle's poses): add it, since a calibration is measured "
            "from motion"
        )
    if len(drive.stamps) < 2:
        raise InputError(f"{drive.name}: has one frame (expected {FEWEST_PAIRS + 1} or more): choose more frames")
    scenes = {stamp.scene for stamp in drive.stamps}
    if len(scenes) > 1:
        raise InputError(f"{drive.name}: has {len(scenes)} scenes (expected one, since rigs differ): choose a `scene`")


def _positions(drive: Sequence) -> tuple[list[int], Array]:
    """Indices of frames, and their positions with headings (F, 3): x, y in metres, yaw in radians."""
    count = len(drive.stamps)
    if drive.ego_motion is not None:
        frames = list(range(count))
        poses = [drive.ego_motion.pose_at(stamp.timestamp_ns) for stamp in drive.stamps]
    else:
        blocks = np.array_split(np.arange(count), max(1, MOST_FRAMES // 6))
        frames = list(range(count)) if count <= MOST_FRAMES else [int(p) for block in blocks for p in block[:6]]
        poses = [drive.load(number).world_from_ego for number in frames]
    return frames, np.array([(*pose.translation[:2], pose.yaw) for pose in poses])


def _choose_pairs(positions: tuple[list[int], Array], most: int) -> list[tuple[int, int]]:
    """Pairs of successive frames between which the vehicle moves; of many, those that turn most and an even choice."""
    frames, at = positions
    pairs, turns, anchor = list[tuple[int, int]](), list[float](), 0
    for k in range(1, len(frames)):
        moved = float(np.hypot(*(at[k, :2] - at[anchor, :2])))
        if moved < NEAREST_M:
            continue
        if moved <= FARTHEST_M:
            pairs.append((frames[anchor], frames[k]))
            turns.append(abs(float(np.angle(np.exp(1j * (at[k, 2] - at[anchor, 2]))))))
        anchor = k
    if len(pairs) <= most:
        return pairs
    chosen = set(np.argsort(turns)[::-1][: most // 2].tolist())
    rest = [k for k in range(len(pairs)) if k not in chosen]
    chosen |= {rest[int(k)] for k in np.linspace(0, len(rest) - 1, most - len(chosen))}
    return [pairs[k] for k in sorted(chosen)]


def _reduced(camera: Camera) -> Camera:
    """The camera of the reduced image. Its pixel (0, 0) is the centre of a larger pixel, so that coordinates shift."""
    width = min(WIDTH, MOST_ENLARGED * camera.width)
    size = (width, round(camera.height * width / camera.width))
    scaled = camera.scaled(size[0] / camera.width, size[1] / camera.height)
    scaled.intrinsics[:2, 2] += (np.array([scaled.width / camera.width, scaled.height / camera.height]) - 1) / 2
    return scaled


def _view(frame: Frame, camera: Camera, motion: EgoMotion | None) -> View | None:
    image = frame.images.get(camera.name)
    if image is None:
        return None
    size = (camera.width, camera.height)
    filtering = cv2.INTER_AREA if camera.width < image.pixels_bgr.shape[1] else cv2.INTER_CUBIC
    grey = cv2.cvtColor(image.pixels_bgr, cv2.COLOR_BGR2GRAY)
    pixels = cv2.resize(grey, size, interpolation=filtering) if grey.shape[::-1] != size else grey
    if pixels.std() < DARKEST:
        return None
    return View(np.asarray(pixels, dtype=np.uint8), _texture(pixels), _poses(frame, camera.name, motion))


def _texture(pixels: NDArray[Any]) -> NDArray[np.uint8]:
    smooth = cv2.GaussianBlur(pixels.astype(np.float32), (0, 0), SMOOTHING)
    fine = smooth - cv2.blur(smooth, (COARSE, COARSE))
    contrast = np.sqrt(np.maximum(cv2.blur(fine**2, (COARSE, COARSE)), 0)) + FLAT
    return np.clip(128 + 40 * fine / contrast, 0, 255).astype(np.uint8)


def _poses(frame: Frame, name: str, motion: EgoMotion | None) -> Array:
    """World_from_ego (25, 4, 4) at the camera's time and DELAYS_S later."""
    time, stated = frame.images[name].timestamp_ns, frame.world_from_ego_at[name].matrix
    poses = []
    for delay in DELAYS_S:
        wanted = time + round(delay * 1e9)
        if motion is None:
            near, left_s = stated, delay
        else:
            within = min(max(wanted, motion.first_ns), motion.last_ns)
            near, left_s = motion.pose_at(within).matrix, (wanted - within) / 1e9
        poses.append(near @ motion_during(left_s, frame.kinematics))
    return np.stack(poses)


DELAY_S, TILT = 0.1, np.radians(0.2)  # standard deviations of capture times and of the ego frame's tilt over the road


def unknowns_of(views: Views, options: CalibrateOptions) -> Unknowns:
    """The unknowns of what a drive shows."""
    groups = views.groups()
    poses = np.stack([[_quaternions(view.poses) for view in views.sides(group)] for group in groups])
    poses[..., 4:] -= poses[:, :1, :1, 4:]
    stated = np.stack([camera.ego_from_camera for camera in views.rig.cameras])
    of_camera = [np.radians(options.rotation_deg)] * 3 + [options.position_m] * 3 + [DELAY_S]
    of_pairs = np.full(OF_PAIR * len(views.pairs), np.radians(options.turn_deg))
    deviations = np.concatenate([np.tile(of_camera, len(stated)), of_pairs, [options.scale, TILT, TILT]])
    return Unknowns(stated, poses, np.array(groups), len(views.pairs), deviations)


def _quaternions(poses: Array) -> Array:
    """Poses (25, 4, 4) as quaternions of one sign and translations, (25, 7)."""
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    turns *= np.sign((turns * turns[:1]).sum(-1, keepdims=True))
    return np.concatenate([turns, poses[:, :3, 3]], axis=-1)


FEATURES = 2000  # an image
RATIO = 0.75  # of the distances to the best and the second best match
INLIER_PX = 1.5
FEWEST_IN_PAIR = 15  # matches of a pair of images; fewer are not used
CELLS = (10, 6)  # of an image, across and down;
MOST_IN_CELL = 6  # matches in one of them, so that no object counts for all
FLATTEST = 0.25  # cosine of the largest angle off the optical axis of a matched ray
_Features = tuple[Array, NDArray[np.float32]]  # pixels (F, 2) and descriptors (F, 128)


@dataclass(frozen=True)
class PointMatches(EpipolarResiduals):
    """M matches of all pairs."""

    same: NDArray[np.bool_]  # (M,) whether both images are of the same camera


def match_points(views: Views) -> PointMatches:
    """The matches of all groups of views."""
    groups = views.groups()
    with ThreadPoolExecutor(THREADS) as threads:
        features = dict(zip(views.of, threads.map(_features, views.of.values()), strict=True))

        def matched(group: tuple[int, int, int]) -> tuple[Array, Array]:
            (a, b), (_, first, second) = views.pairs[group[0]], group
            cameras = views.rig.cameras[first], views.rig.cameras[second]
            return _matched(features[a, first], features[b, second], *cameras)

        rays = list(threads.map(matched, groups))
    counts = [len(a) for a, _ in rays]
    rays_a, rays_b = (np.concatenate(side) for side in zip(*rays, strict=True))
    _, first, second = (np.repeat(column, counts) for column in np.array(groups).T)
    group = np.repeat(np.arange(len(counts)), counts)
    focal = np.array([camera.intrinsics[0, 0] for camera in views.rig.cameras])[first]
    return PointMatches(group, rays_a, rays_b, focal, first == second)


def _features(view: View) -> _Features:
    detector = cv2.SIFT.create(nfeatures=FEATURES, enable_precise_upscale=True)
    points, descriptors = detector.detectAndCompute(view.pixels, None)
    if descriptors is None:
        return np.zeros((0, 2)), np.zeros((0, 128), dtype=np.float32)
    return np.array([point.pt for point in points], dtype=np.float64), np.asarray(descriptors, dtype=np.float32)


def _matched(a: _Features, b: _Features, first: Camera, second: Camera) -> tuple[Array, Array]:
    """Rays (m, 3) and (m, 3) of the matches; those within one camera fit one rigid motion."""
    nothing = np.zeros((0, 3)), np.zeros((0, 3))
    if min(len(a[0]), len(b[0])) < FEWEST_IN_PAIR:
        return nothing
    nearest, quality, other = _nearest(a[1], b[1])
    kept = quality < RATIO**2 * other
    if kept.sum() < FEWEST_IN_PAIR:
        return nothing
    pixels_a, quality = a[0][kept], quality[kept]
    rays_a, rays_b = first.rays(pixels_a), second.rays(b[0][nearest[kept]])
    with np.errstate(invalid="ignore"):
        good = (rays_a[:, 2] > FLATTEST) & (rays_b[:, 2] > FLATTEST)
    if first is second:
        good[good] = _rigid(rays_a[good], rays_b[good], first)
    chosen = np.flatnonzero(good)
    # SIFT gives a point with several orientations several times.
    chosen = chosen[np.sort(np.unique(pixels_a[chosen].astype(int), axis=0, return_index=True)[1])]
    chosen = chosen[_spread(pixels_a[chosen], quality[chosen].astype(np.float64), first)]
    return rays_a[chosen], rays_b[chosen]


def _nearest(
    a: NDArray[np.float32], b: NDArray[np.float32]
) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float32]]:
    """The nearest of the descriptors b (F, 128) for each of a (A, 128); squared distances to it and to the next one.

    A matrix product is three times as fast as OpenCV's matcher, and as exact: SIFT's descriptors are whole numbers.
    """
    distances = (b**2).sum(-1) - 2 * (a @ b.T)
    rows, nearest = np.arange(len(a)), distances.argmin(-1)
    best = distances[rows, nearest]
    distances[rows, nearest] = np.inf
    lengths = (a**2).sum(-1)
    return nearest, lengths + best, lengths + distances.min(-1)


def _rigid(rays_a: Array, rays_b: Array, camera: Camera) -> NDArray[np.bool_]:
    """(m,) the matches that one rigid motion explains: all others move by themselves, or are wrong."""
    nothing = np.zeros(len(rays_a), dtype=bool)
    if len(rays_a) < FEWEST_IN_PAIR:
        return nothing
    flat_a, flat_b = (rays[:, :2] / rays[:, 2:] for rays in (rays_a, rays_b))
    threshold = INLIER_PX / camera.intrinsics[0, 0]
    _, inliers = cv2.findEssentialMat(flat_a, flat_b, np.eye(3), cv2.RANSAC, 0.999, threshold)
    if inliers is None or inliers.sum() < FEWEST_IN_PAIR:
        return nothing
    return np.asarray(inliers.ravel() > 0)


def _spread(pixels: Array, distance: Array, camera: Camera) -> NDArray[np.int64]:
    cell = (pixels / [camera.width, camera.height] * CELLS).astype(int).clip(0, np.array(CELLS) - 1) @ [1, CELLS[0]]
    order = np.lexsort((distance, cell))
    first = np.searchsorted(cell[order], cell[order])
    return np.sort(order[np.arange(len(order)) - first < MOST_IN_CELL])
