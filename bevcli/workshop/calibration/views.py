"""The frame pairs of a drive that are used, the grey images of their frames, and the points matched in both."""

from collections.abc import Generator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bevcli.errors import InputError
from bevcli.frame import Drive, Frame
from bevcli.geometry.cameras import Camera, CameraRig
from bevcli.geometry.ego_motion import EgoMotion, Kinematics
from bevcli.geometry.transforms import Array, rigid
from bevcli.workshop.calibration import CalibrateOptions
from bevcli.workshop.calibration.estimates import DELAYS_S, OF_PAIR, Unknowns
from bevcli.workshop.correspondence.images import (
    THREADS,
    WIDTH,
    GreyImage,
    features,
    grey_image,
    matched,
    neighbours,
    reduced,
)
from bevcli.workshop.correspondence.residuals import DepthResiduals, EpipolarResiduals

NEAREST_M, FARTHEST_M = 0.8, 12.0  # distance driven between the frames of a pair
MOST_FRAMES = 120  # that are read where the poses of the drive are known only with its images
FEWEST_PAIRS = 6  # a measurement from fewer would be sure of an error of the poses
READING_STEPS = 10  # of progress


@dataclass(frozen=True)
class View(GreyImage):
    """One camera's image at one time."""

    poses: Array  # (25, 4, 4) world_from_ego when it was taken, and each of DELAYS_S later


@dataclass(frozen=True)
class Views:
    """What a drive shows."""

    stated: CameraRig  # the rig of the frames
    rig: CameraRig  # the same with cameras for the reduced images
    pairs: tuple[tuple[int, int], ...]  # indices of the frames of each pair
    of: dict[tuple[int, int], View]  # (frame index, camera index) -> view; missing images are left out
    apart: bool = False  # each camera by itself: nothing is compared with its neighbours

    def neighbours(self) -> list[tuple[int, int]]:
        """Each camera with its neighbours, as indices."""
        return [] if self.apart else neighbours(self.rig.cameras)

    def groups(self) -> list[tuple[int, int, int]]:
        """(pair, camera of its first frame, camera of its second one): each camera with itself and its neighbours."""
        cameras = [(index, index) for index in range(len(self.rig.cameras))] + self.neighbours()
        return [
            (pair, first, second)
            for pair, (a, b) in enumerate(self.pairs)
            for first, second in cameras
            if (a, first) in self.of and (b, second) in self.of
        ]

    def at_once(self) -> list[tuple[int, int, int]]:
        """(pair, first camera, second camera): neighbours in the first frame of each pair."""
        return [
            (pair, first, second)
            for pair, (a, _) in enumerate(self.pairs)
            for first, second in self.beside()
            if (a, first) in self.of and (a, second) in self.of
        ]

    def beside(self) -> list[tuple[int, int]]:
        """Each two neighbours once."""
        return [(first, second) for first, second in self.neighbours() if first < second]

    def all_groups(self) -> list[tuple[tuple[int, int, int], bool]]:
        """Those of `groups` and then those of `at_once`, and whether the vehicle moves between their images."""
        return [(group, True) for group in self.groups()] + [(group, False) for group in self.at_once()]

    def sides(self, group: tuple[int, int, int], moves: bool = True) -> tuple[View, View]:
        """The two views of a group."""
        (a, b), (_, first, second) = self.pairs[group[0]], group
        return self.of[a, first], self.of[b if moves else a, second]


def read_views(drive: Drive, most_pairs: int, width: int = WIDTH) -> Generator[None, None, Views]:
    """The views of a drive: yields READING_STEPS times while it is read, and returns them.

    width: of the reduced images, pixels. Raises InputError where the drive does not show how its cameras move.
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
            stated_rig = frame.rig
            rig = replace(frame.rig, cameras=tuple(reduced(camera, width) for camera in frame.rig.cameras))
        for index, camera in enumerate(rig.cameras):
            view = _view(frame, camera, drive.ego_motion)
            if view is not None:
                views[frame_index, index] = view
        yield from steps_reached(READING_STEPS, done, len(frames))
    if not views:
        raise InputError(f"{drive.name}: no image shows anything (expected images with contrast, not black ones)")
    return Views(stated_rig, rig, tuple(pairs), views)


def steps_reached(steps: int, done: int, total: int) -> list[None]:
    """The steps of progress, of some in all, that the last one of `done` parts of `total` has reached."""
    return [None] * (steps * done // total - steps * (done - 1) // total)


def _check(drive: Drive) -> None:
    if not drive.has_ego_motion:
        raise InputError(
            f"{drive.name}: has no ego-motion (expected the vehicle's poses, since a calibration is measured from "
            "motion): add it, or measure it from the images too: `odometry` (`--odometry`)"
        )
    if len(drive.stamps) < 2:
        raise InputError(f"{drive.name}: has one frame (expected {FEWEST_PAIRS + 1} or more): choose more frames")
    scenes = {stamp.scene for stamp in drive.stamps}
    if len(scenes) > 1:
        raise InputError(
            f"{drive.name}: has {len(scenes)} scenes (expected one, since rigs differ): choose a `scene` (`--scene`)"
        )


def _positions(drive: Drive) -> tuple[list[int], Array]:
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
    selected = set(np.argsort(turns)[::-1][: most // 2].tolist())
    rest = [k for k in range(len(pairs)) if k not in selected]
    selected |= {rest[int(k)] for k in np.linspace(0, len(rest) - 1, most - len(selected))}
    return [pairs[k] for k in sorted(selected)]


def _view(frame: Frame, camera: Camera, motion: EgoMotion | None) -> View | None:
    image = frame.images.get(camera.name)
    grey = grey_image(image.pixels_bgr, camera) if image is not None else None
    return View(grey.pixels, grey.texture, _poses(frame, camera.name, motion)) if grey is not None else None


def _poses(frame: Frame, name: str, motion: EgoMotion | None) -> Array:
    """World_from_ego (25, 4, 4) at the camera's time and DELAYS_S later."""
    time, stated_pose = frame.images[name].timestamp_ns, frame.world_from_ego_at[name].matrix
    poses = []
    for delay in DELAYS_S:
        nearest, beyond_s = stated_pose, delay
        if motion is not None:
            delayed = time + round(delay * 1e9)
            within = min(max(delayed, motion.first_ns), motion.last_ns)
            nearest, beyond_s = motion.pose_at(within).matrix, (delayed - within) / 1e9
        poses.append(nearest @ motion_during(beyond_s, frame.kinematics))
    return np.stack(poses)


DELAY_S, TILT = 0.1, np.radians(0.2)  # standard deviations of capture times and of the ego frame's tilt over the road
LENSES = np.radians([0.02, 0.02, 1.0])  # of what looks like a rotation between neighbours: lines of points tell no yaw


def unknowns_of(views: Views, options: CalibrateOptions) -> Unknowns:
    """The unknowns of what a drive shows."""
    groups = [group for group, _ in views.all_groups()]
    poses = np.stack([[_quaternions(view.poses) for view in views.sides(*group)] for group in views.all_groups()])
    poses[..., 4:] -= poses[:, :1, :1, 4:]
    ego_from_camera = np.stack([camera.ego_from_camera for camera in views.rig.cameras])
    pairs, beside = len(views.pairs), views.beside()
    turns = [group[0] if moves else pairs + beside.index(group[1:]) for group, moves in views.all_groups()]
    of_camera = [np.radians(options.rotation_deg)] * 3 + [options.position_m] * 3 + [DELAY_S]
    of_turns = [np.full(OF_PAIR * pairs, np.radians(options.turn_deg)), np.tile(LENSES, len(beside))]
    deviations = np.concatenate([np.tile(of_camera, len(ego_from_camera)), *of_turns, [options.scale, TILT, TILT]])
    return Unknowns(ego_from_camera, poses, np.array(groups), np.array(turns), pairs, len(beside), deviations)


def _quaternions(poses: Array) -> Array:
    """Poses (25, 4, 4) as quaternions of one sign and translations, (25, 7)."""
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    turns *= np.sign((turns * turns[:1]).sum(-1, keepdims=True))
    return np.concatenate([turns, poses[:, :3, 3]], axis=-1)


@dataclass(frozen=True)
class PointMatches(EpipolarResiduals):
    """M matches of all pairs."""

    same: NDArray[np.bool_]  # (M,) whether both images are of the same camera
    moves: NDArray[np.bool_]  # (M,) whether they are of both frames; else of one


def match_points(views: Views) -> PointMatches:
    """The matches of all groups of views."""
    groups, moves = zip(*views.all_groups(), strict=True)
    with ThreadPoolExecutor(THREADS) as threads:
        described = dict(zip(views.of, threads.map(features, views.of.values()), strict=True))

        def of_group(group: tuple[int, int, int], moves: bool) -> tuple[Array, Array]:
            (a, b), (_, first, second) = views.pairs[group[0]], group
            cameras = views.rig.cameras[first], views.rig.cameras[second]
            return matched(described[a, first], described[b if moves else a, second], *cameras, at_once=not moves)

        rays = list(threads.map(of_group, groups, moves))
    counts = [len(a) for a, _ in rays]
    rays_a, rays_b = (np.concatenate(side) for side in zip(*rays, strict=True))
    _, first, second = (np.repeat(column, counts) for column in np.array(groups).T)
    group = np.repeat(np.arange(len(counts)), counts)
    focal = np.array([camera.intrinsics[0, 0] for camera in views.rig.cameras])[first]
    return PointMatches(group, rays_a, rays_b, focal, first == second, np.repeat(moves, counts))


def depths_of(unknowns: Unknowns, matches: PointMatches) -> DepthResiduals:
    """The points that a camera sees in both frames of a pair, and its neighbour in the first one."""
    within, at_once = matches.where(matches.same), matches.where(~matches.moves)
    keys_within, keys = (
        [(pair, camera, *ray) for (pair, camera, _), ray in zip(unknowns.groups[some.group], some.rays_a, strict=True)]
        for some in (within, at_once)
    )
    later = dict(zip(keys_within, within.rays_b, strict=True))
    cross = {tuple(group): index for index, group in enumerate(unknowns.groups[unknowns.moves].tolist())}
    groups = [cross.get(tuple(group)) for group in unknowns.groups[at_once.group].tolist()]
    kept = np.array([k for k, key in enumerate(keys) if key in later and groups[k] is not None], dtype=np.int64)
    kept = kept[np.argsort([groups[k] for k in kept], kind="stable")]
    group = np.array([groups[k] for k in kept], dtype=np.int64)
    rays_later = np.array([later[keys[k]] for k in kept]).reshape(-1, 3)
    return DepthResiduals(group, at_once.rays_a[kept], at_once.rays_b[kept], rays_later, at_once.focal[kept])


def motion_during(seconds: float, kinematics: Kinematics) -> Array:
    """(4, 4) ego_from_later_ego: the motion at constant velocity and angular rate. seconds: may be negative."""
    turn, _ = cv2.Rodrigues(seconds * kinematics.angular_rate)
    half_turn, _ = cv2.Rodrigues(seconds / 2 * kinematics.angular_rate)
    return rigid(half_turn @ (seconds * np.asarray(kinematics.velocity)), turn)
