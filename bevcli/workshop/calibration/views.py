"""The frame pairs of a drive that are used, and the grey images of their frames."""

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.frame import Frame, Sequence
from bevcli.geometry.cameras import Camera, CameraRig
from bevcli.geometry.ego_motion import EgoMotion, motion_during
from bevcli.geometry.transforms import Array

WIDTH, MOST_ENLARGED = 1000, 2  # pixels: all images are brought to this width; largest factor
NEAREST_M, FARTHEST_M = 0.8, 12.0  # distance driven between the frames of a pair
MOST_FRAMES = 120  # that are read where the poses of the drive are known only with its images
FEWEST_PAIRS = 6  # a measurement from fewer would be sure of an error of the poses
THREADS = min(os.cpu_count() or 1, 8)  # each needs about 150 MB while it finds features
READING_STEPS = 10  # of progress
DARKEST = 4  # grey levels of standard deviation; an image with less shows nothing
SMOOTHING, COARSE = 1.2, 35  # pixels: finer structure is noise, coarser is light and shade
FLAT = 1.0  # grey levels, a weaker structure is noise
DELAYS_S = np.linspace(-0.3, 0.3, 25)  # of a camera's capture times, where the motion of a pair is tabulated


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
    pairs: tuple[tuple[int, int], ...]  # places of the frames of each pair
    of: dict[tuple[int, int], View]  # (place, camera index) -> view; missing images are left out

    def groups(self) -> list[tuple[int, int, int]]:
        """(pair, camera of its first frame, camera of its second one): each camera with itself and its neighbours."""
        cameras = [(each, each) for each in range(len(self.rig.cameras))] + self.neighbours()
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
    """Places of frames, and their positions with headings (F, 3): x, y in metres, yaw in radians."""
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
