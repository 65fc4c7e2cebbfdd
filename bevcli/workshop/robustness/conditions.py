"""The corruptions of `bevcli stress` with their severities, and the sequences that apply them to another one."""

import hashlib
import os
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from enum import Enum, auto
from functools import partial
from typing import Any

import cv2
import numpy as np

from bevcli.errors import InputError
from bevcli.frame import CameraImage, DerivedDrive, Drive, Frame, FrameStamp
from bevcli.geometry.cameras import OUTSIDE, Camera, CameraRig, camera_pose_noise
from bevcli.geometry.transforms import Array, Pose, inverse
from bevcli.sequences.open import select
from bevcli.workshop.calibration.views import motion_during
from bevcli.workshop.robustness import LostImage, SeverityChoice
from bevcli.workshop.synth import corruptions
from bevcli.workshop.synth.corruptions import ImageCorruption, Level, Pixels
from bevcli.workshop.synth.rig import tilt

LOST_PARTS = 6  # level L loses an image or a pose with probability L/6
MOST_CRASHES = 5  # draws of cameras at the hardest level


@dataclass(frozen=True)
class Draws:
    """The random numbers of one corruption, from the seed of the whole test and the name of the corruption.

    The severity is no part of the key: a harder severity draws the same numbers as an easier one, so that, for example,
    it loses the same images and more.
    """

    seed: int
    corruption: str

    def generator(self, *keys: str | int) -> np.random.Generator:
        """A generator for what the keys name, such as scene, frame index and camera."""
        digest = hashlib.sha256("\0".join(map(str, (self.corruption, *keys))).encode()).digest()
        return np.random.default_rng([self.seed, *np.frombuffer(digest, dtype="<u4").tolist()])


class ChangedDrive(DerivedDrive):
    """A sequence whose frames are changed when they are loaded. A subclass overrides `change`.

    level: of the change; its meaning depends on the subclass. lost_images: what the model gets for a lost image.
    """

    def __init__(self, sequence: Drive, level: Level, draws: Draws, lost_images: LostImage = "black") -> None:
        super().__init__(sequence)
        self._level, self._draws, self._lost_images = level, draws, lost_images

    def random(self, stamp: FrameStamp, *keys: str | int) -> np.random.Generator:
        """A generator for the scene of a frame and further keys; it does not depend on where the drive is stored."""
        return self._draws.generator(f"{self.name}/{stamp.scene}", *keys)


class CorruptedImages(ChangedDrive):
    """A sequence with every image corrupted by `corrupt`. Each frame and camera has its own random numbers."""

    def __init__(self, *arguments: Any, corrupt: ImageCorruption) -> None:
        super().__init__(*arguments)
        self._corrupt = corrupt

    def change(self, index: int, frame: Frame) -> Frame:
        def corrupted(name: str) -> Pixels:
            random = self.random(frame.stamp, frame.stamp.index, name)
            return self._corrupt(frame.images[name].pixels_bgr, self._level, random)

        return _with_images(frame, corrupted)


def _with_images(frame: Frame, change: Callable[[str], Pixels]) -> Frame:
    """The frame with other pixels. change: gives those of a camera; it is called in several threads."""
    with ThreadPoolExecutor(min(max(len(frame.images), 1), os.cpu_count() or 1)) as threads:
        changed = dict(zip(frame.images, threads.map(change, frame.images), strict=True))
    return replace(frame, images={name: _with_pixels(image, changed[name]) for name, image in frame.images.items()})


def _with_pixels(image: CameraImage, pixels_bgr: Pixels) -> CameraImage:
    return replace(image, pixels_bgr=pixels_bgr, encoded=None, media_type=None)


def at_lower_rate(sequence: Drive, step: int) -> tuple[Drive, ...]:
    """The frames of one scene at 1/step of its rate, as `step` sequences that start one frame after another.

    Together they have every frame once, so that the score covers the same ground truth as at the full rate.
    """
    count = len(sequence.stamps)
    return tuple(select(sequence, range(start, count, step)) for start in range(min(step, count)))


class LostImages(ChangedDrive):
    """A sequence that loses images: they are missing or black. A subclass overrides `lost`."""

    def lost(self, frame: Frame) -> Collection[str]:
        """The cameras whose images are lost."""
        raise NotImplementedError

    def change(self, index: int, frame: Frame) -> Frame:
        all_lost = self.lost(frame)
        lost = [name for name in frame.images if name in all_lost]
        if self._lost_images == "missing":
            kept = {name: image for name, image in frame.images.items() if name not in lost}
            dropped = {**frame.dropped, **dict.fromkeys(lost, "lost by bevcli stress")}
            return replace(frame, images=kept, dropped=dropped)
        black = {name: _with_pixels(frame.images[name], np.zeros_like(frame.images[name].pixels_bgr)) for name in lost}
        return replace(frame, images={**frame.images, **black})


class CameraCrash(LostImages):
    """Level L draws L cameras of the rig, with replacement; they deliver nothing for the whole scene."""

    def lost(self, frame: Frame) -> Collection[str]:
        names = frame.rig.names
        drawn = self.random(frame.stamp).integers(0, len(names), MOST_CRASHES)
        return {names[index] for index in drawn[: self._level]}


class FrameLost(LostImages):
    """Level L loses each image with a probability of L/6, independently of the others."""

    def lost(self, frame: Frame) -> Collection[str]:
        stamp, limit = frame.stamp, self._level / LOST_PARTS
        return {name for name in frame.rig.names if self.random(stamp, stamp.index, name).random() < limit}


class CalibrationNoise(ChangedDrive):
    """A sequence whose cameras state wrong poses, the same ones for a whole scene; levels of `camera_pose_noise`."""

    _noisy: tuple[CameraRig, str, CameraRig] | None = None  # a rig, its scene and the noisy rig that its frames share

    def change(self, index: int, frame: Frame) -> Frame:
        stamp = frame.stamp
        if self._noisy is None or self._noisy[0] is not frame.rig or self._noisy[1] != stamp.scene:
            noise = {name: camera_pose_noise(self._level, self.random(stamp, name)) for name in frame.rig.names}
            cameras = tuple(
                replace(camera, ego_from_camera=camera.ego_from_camera @ noise[camera.name])
                for camera in frame.rig.cameras
            )
            self._noisy = (frame.rig, stamp.scene, replace(frame.rig, cameras=cameras))
        return replace(frame, rig=self._noisy[2])


class BodyPitch(ChangedDrive):
    """A sequence whose body pitches and rolls, each frame anew; poses and calibration do not tell.

    Level L draws a pitch with a standard deviation of L/2 degrees, and a roll with half of that. All images of a frame
    are turned together about their cameras, which stay in place. What comes in from outside repeats an image's edge.
    """

    def change(self, index: int, frame: Frame) -> Frame:
        draws = self.random(frame.stamp, frame.stamp.index).standard_normal(2)
        level_from_body = tilt(*np.radians(self._level / 2 * draws * (1, 0.5)))

        def turned(name: str) -> Pixels:
            return _turned(frame.images[name].pixels_bgr, frame.rig[name], level_from_body)

        return _with_images(frame, turned)


def _turned(pixels: Pixels, camera: Camera, level_from_body: Array) -> Pixels:
    """The image (H, W, 3) of a camera on a turned body, from that on the level one. level_from_body: (3, 3)."""
    rows, columns = np.indices(pixels.shape[:2])
    ego_from_camera = camera.ego_from_camera[:3, :3]
    turn = ego_from_camera.T @ level_from_body @ ego_from_camera
    seen, _ = camera.project(camera.rays(np.stack([columns, rows], axis=-1)) @ turn.T)
    at = np.nan_to_num(seen, nan=OUTSIDE).astype(np.float32)
    turned = cv2.remap(pixels, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return turned.astype(np.uint8, copy=False)


class TimeOffsets(ChangedDrive):
    """A sequence whose cameras state wrong capture times: each camera is off by its own constant, for a whole scene.

    Level L draws each offset uniformly from -L to L milliseconds. The pose of the vehicle at the camera's time is then
    that of the wrong time: the vehicle is moved on with the frame's velocity and angular rate. Images stay.
    """

    def change(self, index: int, frame: Frame) -> Frame:
        draws = {name: self.random(frame.stamp, name).uniform(-1, 1) for name in frame.rig.names}
        offsets_s = {name: self._level / 1000 * draw for name, draw in draws.items()}
        poses = {
            name: Pose.from_matrix(pose.matrix @ motion_during(offsets_s[name], frame.kinematics))
            for name, pose in frame.world_from_ego_at.items()
        }
        images = {
            name: replace(image, timestamp_ns=image.timestamp_ns + round(offsets_s[name] * 1e9))
            for name, image in frame.images.items()
        }
        return replace(frame, world_from_ego_at=poses, images=images)


class EgoMotionLost(ChangedDrive):
    """A sequence in which poses do not arrive: the last pose and kinematics that arrived are used instead.

    Level L loses the pose of a frame with a probability of L/6; the first frame of a scene keeps its pose. The ground
    truth is moved with the pose, so that it stays where it is relative to the vehicle.
    """

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._arrived: dict[int, Frame] = {}

    def change(self, index: int, frame: Frame) -> Frame:
        last = self._last_arrived(index)
        if last not in self._arrived:
            earlier = frame if last == index else self.drive.load(last)
            self._arrived[last] = replace(earlier, images={}, ground_truth=None)
        if last == index:
            return frame
        arrived = self._arrived[last]
        pose = arrived.world_from_ego
        stated_from_world = pose.matrix @ inverse(frame.world_from_ego.matrix)
        truth = frame.ground_truth
        return replace(
            frame,
            world_from_ego=pose,
            world_from_ego_at=dict.fromkeys(frame.world_from_ego_at, pose),
            kinematics=arrived.kinematics,
            road_normal=arrived.road_normal,
            ground_truth=None if truth is None else truth.transformed(stated_from_world),
        )

    def _last_arrived(self, index: int) -> int:
        stamps = self.stamps
        while index > 0 and stamps[index - 1].scene == stamps[index].scene:
            if self.random(stamps[index], stamps[index].index).random() >= self._level / LOST_PARTS:
                break
            index -= 1
        return index


# Makes of a scene what is run in its place, for a level: several sequences if they must not share a history.
Apply = Callable[[Drive, int, Draws, LostImage], Drive | tuple[Drive, ...]]


class Group(Enum):
    """Corruptions whose scores are averaged together."""

    ROBOBEV = auto()  # as published: mRR and mCE
    UNSEEN = auto()  # those of ImageNet-C that no training here uses
    OTHER = auto()  # averaged with nothing


@dataclass(frozen=True)
class Corruption:
    """A kind of corruption with its severities."""

    name: str  # on the command line and in stress.json
    levels: Mapping[str, int]  # severity, such as "easy", or a number -> level
    apply: Apply  # makes of a scene what is run
    group: Group = Group.ROBOBEV  # of those that it is averaged with


@dataclass(frozen=True)
class Condition:
    """One corruption at one severity."""

    corruption: Corruption  # CLEAN for clean drives
    severity: str  # a key of `Corruption.levels`

    @property
    def name(self) -> str:
        return self.corruption.name

    def sequences(self, scene: Drive, seed: int, kind: LostImage) -> tuple[Drive, ...]:
        """The sequences that are run in place of a scene."""
        changed = self.corruption.apply(scene, self.corruption.levels[self.severity], Draws(seed, self.name), kind)
        return changed if isinstance(changed, tuple) else (changed,)


def _severities(easy: int, mid: int, hard: int) -> dict[str, int]:
    return {"easy": easy, "mid": mid, "hard": hard}


def _of_images(corrupt: ImageCorruption, *levels: int, group: Group = Group.ROBOBEV) -> Corruption:
    """A corruption of each image alone, named as its function."""
    return Corruption(corrupt.__name__, _severities(*levels), partial(CorruptedImages, corrupt=corrupt), group)


CLEAN = Corruption("clean", {"": 0}, lambda scene, *_: scene, Group.OTHER)
CORRUPTIONS = (
    # Levels of the first eight as published: RoboBEV, docs/CREATE.md.
    Corruption("camera_crash", _severities(2, 4, 5), CameraCrash),
    Corruption("frame_lost", _severities(2, 4, 5), FrameLost),
    _of_images(corruptions.color_quantisation, 1, 2, 3),
    _of_images(corruptions.motion_blur, 2, 4, 5),
    _of_images(corruptions.brightness, 2, 4, 5),
    _of_images(corruptions.low_light, 2, 3, 4),
    _of_images(corruptions.fog, 2, 4, 5),
    _of_images(corruptions.snow, 1, 2, 3),
    _of_images(corruptions.defocus_blur, 2, 4, 5, group=Group.UNSEEN),
    _of_images(corruptions.low_contrast, 2, 4, 5, group=Group.UNSEEN),
    _of_images(corruptions.impulse_noise, 2, 4, 5, group=Group.UNSEEN),
    _of_images(corruptions.jpeg, 2, 4, 5, group=Group.UNSEEN),
    _of_images(corruptions.saturation, 2, 4, 5, group=Group.UNSEEN),
    Corruption("calibration_noise", {"1": 1, "2": 2, "3": 3, "4": 4}, CalibrationNoise, Group.OTHER),
    Corruption("body_pitch", _severities(1, 2, 3), BodyPitch, Group.OTHER),
    Corruption("time_offset", _severities(50, 100, 200), TimeOffsets, Group.OTHER),
    Corruption("ego_motion_lost", _severities(2, 4, 5), EgoMotionLost, Group.OTHER),
    Corruption("frame_rate", _severities(2, 3, 4), lambda scene, step, *_: at_lower_rate(scene, step), Group.OTHER),
)
NAMES = tuple(corruption.name for corruption in CORRUPTIONS)
_GROUP_OF_LEVEL = {"1": "easy", "2": "mid", "3": "mid", "4": "hard"}  # of corruptions with numbered levels


def choose_conditions(severity: SeverityChoice = "all", only: Sequence[str] = ()) -> tuple[Condition, ...]:
    """The conditions of a test: clean first, then the corruptions in the order of CORRUPTIONS.

    severity: only conditions of this severity; of the numbered levels, 1 is easy, 2 and 3 are mid, 4 is hard.
    only: names of corruptions; empty for all. Raises InputError for an unknown name.
    """
    unknown = [name for name in only if name not in NAMES]
    if unknown:
        raise InputError(f"`only={unknown[0]}` (`--only`): unknown corruption (expected one of {', '.join(NAMES)})")
    chosen = [
        Condition(corruption, label)
        for corruption in CORRUPTIONS
        if not only or corruption.name in only
        for label in corruption.levels
        if severity in ("all", _GROUP_OF_LEVEL.get(label, label))
    ]
    return (Condition(CLEAN, ""), *chosen)
