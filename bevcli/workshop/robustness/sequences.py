"""Sequences that wrap another one: with faults of images, calibration, times and poses; in memory; at a lower rate."""

import hashlib
import os
from collections.abc import Collection
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bevcli.errors import InputError
from bevcli.frame import CameraImage, DerivedSequence, Frame, FrameStamp, Sequence
from bevcli.geometry.cameras import Camera, CameraRig, camera_pose_noise
from bevcli.geometry.ego_motion import Kinematics, motion_during
from bevcli.geometry.transforms import Pose, inverse
from bevcli.sequences.open import scenes_of, select
from bevcli.workshop.robustness.options import LostImage
from bevcli.workshop.synth.corruptions import ImageCorruption, Level, Pixels


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


KEPT_BYTES = 1 << 30  # decoded images that are kept in memory, of all drives together


class ChangedSequence(DerivedSequence):
    """A sequence whose frames are changed when they are loaded. A subclass overrides `change`.

    level: of the change; its meaning depends on the subclass. lost_images: what the model gets for a lost image.
    """

    def __init__(self, sequence: Sequence, level: Level, draws: Draws, lost_images: LostImage = "black") -> None:
        super().__init__(sequence)
        self._level, self._draws, self._lost_images = level, draws, lost_images

    def load(self, place: int) -> Frame:
        return self.change(place, self.sequence.load(place))

    def change(self, place: int, frame: Frame) -> Frame:
        """The frame at a place with its change."""
        raise NotImplementedError

    def random(self, stamp: FrameStamp, *keys: str | int) -> np.random.Generator:
        """A generator for the scene of a frame and further keys; it does not depend on where the drive is stored."""
        return self._draws.generator(f"{self.name}/{stamp.scene}", *keys)


class CorruptedImages(ChangedSequence):
    """A sequence with every image corrupted by `corrupt`. Each frame and camera has its own random numbers."""

    def __init__(self, *arguments: Any, corrupt: ImageCorruption) -> None:
        super().__init__(*arguments)
        self._corrupt = corrupt

    def change(self, place: int, frame: Frame) -> Frame:
        def corrupted(name: str) -> CameraImage:
            random = self.random(frame.stamp, frame.stamp.index, name)
            return _with_pixels(frame.images[name], self._corrupt(frame.images[name].pixels_bgr, self._level, random))

        with ThreadPoolExecutor(min(max(len(frame.images), 1), os.cpu_count() or 1)) as threads:
            images = dict(zip(frame.images, threads.map(corrupted, frame.images), strict=True))
        return replace(frame, images=images)


def _with_pixels(image: CameraImage, pixels_bgr: Pixels) -> CameraImage:
    return replace(image, pixels_bgr=pixels_bgr, encoded=None, media_type=None)


@dataclass
class FrameStore:
    """The memory that `KeptFrames` of several drives share; frames beyond it are read again each time.

    Attributes:
        left: bytes of decoded images that still fit.
    """

    left: int = KEPT_BYTES


class KeptFrames(DerivedSequence):
    """Keeps decoded frames, without the bytes of files, while the memory lasts, because every condition needs them."""

    def __init__(self, sequence: Sequence, store: FrameStore) -> None:
        super().__init__(sequence)
        self._store = store
        self._frames: dict[int, Frame] = {}

    def load(self, place: int) -> Frame:
        if place in self._frames:
            return self._frames[place]
        frame = self.sequence.load(place)
        images = {name: _with_pixels(image, image.pixels_bgr) for name, image in frame.images.items()}
        frame = replace(frame, images=images)
        size = sum(image.pixels_bgr.nbytes for image in images.values())
        if size <= self._store.left:
            self._store.left -= size
            self._frames[place] = frame
        return frame


def split_scenes(sequence: Sequence) -> list[Sequence]:
    """One sequence per scene. Raises InputError if the sequence has no frames."""
    if not sequence.stamps:
        raise InputError(f"{sequence.name}: has no frames")
    return [select(sequence, places) for places in scenes_of(sequence.stamps)]


def at_lower_rate(sequence: Sequence, step: int) -> tuple[Sequence, ...]:
    """The frames of one scene at 1/step of its rate, as `step` sequences that start one frame after another.

    Together they have every frame once, so that the score covers the same ground truth as at the full rate.
    """
    count = len(sequence.stamps)
    return tuple(select(sequence, range(start, count, step)) for start in range(min(step, count)))


MOST_CRASHES = 5  # draws of cameras at the hardest level
LOST_PARTS = 6  # level L loses an image or a pose with probability L/6


class LostImages(ChangedSequence):
    """A sequence that loses images: they are missing or black. A subclass overrides `lost`."""

    def lost(self, frame: Frame) -> Collection[str]:
        """The cameras whose images are lost."""
        raise NotImplementedError

    def change(self, place: int, frame: Frame) -> Frame:
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


class CalibrationNoise(ChangedSequence):
    """A sequence whose cameras state wrong poses, the same ones for a whole scene; levels of `camera_pose_noise`."""

    # A rig, its scene and the noisy rig, which the frames of a scene with one rig share.
    _noisy: tuple[CameraRig, str, CameraRig] | None = None

    def change(self, place: int, frame: Frame) -> Frame:
        stamp = frame.stamp
        if self._noisy is None or self._noisy[0] is not frame.rig or self._noisy[1] != stamp.scene:
            cameras = tuple(self._with_noise(camera, stamp) for camera in frame.rig.cameras)
            self._noisy = (frame.rig, stamp.scene, replace(frame.rig, cameras=cameras))
        return replace(frame, rig=self._noisy[2])

    def _with_noise(self, camera: Camera, stamp: FrameStamp) -> Camera:
        noise = camera_pose_noise(self._level, self.random(stamp, camera.name))
        return replace(camera, ego_from_camera=camera.ego_from_camera @ noise)


class TimeOffsets(ChangedSequence):
    """A sequence whose cameras state wrong capture times: each camera is off by its own constant, for a whole scene.

    Level L draws each offset uniformly from -L to L milliseconds. The pose of the vehicle at the camera's time is then
    that of the wrong time: the vehicle is moved on with the frame's velocity and angular rate. Images stay.
    """

    def change(self, place: int, frame: Frame) -> Frame:
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


class EgoMotionLost(ChangedSequence):
    """A sequence in which poses do not arrive: the last pose and kinematics that arrived are used instead.

    Level L loses the pose of a frame with a probability of L/6; the first frame of a scene keeps its pose. The ground
    truth is moved with the pose, so that it stays where it is relative to the vehicle.
    """

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._arrived: dict[int, tuple[Pose, Kinematics]] = {}

    def change(self, place: int, frame: Frame) -> Frame:
        last = self._last_arrived(place)
        if last not in self._arrived:
            earlier = frame if last == place else self.sequence.load(last)
            self._arrived[last] = earlier.world_from_ego, earlier.kinematics
        if last == place:
            return frame
        pose, kinematics = self._arrived[last]
        stated_from_world = pose.matrix @ inverse(frame.world_from_ego.matrix)
        truth = frame.ground_truth
        return replace(
            frame,
            world_from_ego=pose,
            world_from_ego_at=dict.fromkeys(frame.world_from_ego_at, pose),
            kinematics=kinematics,
            ground_truth=None if truth is None else truth.transformed(stated_from_world),
        )

    def _last_arrived(self, place: int) -> int:
        stamps = self.stamps
        while place > 0 and stamps[place - 1].scene == stamps[place].scene:
            if self.random(stamps[place], stamps[place].index).random() >= self._level / LOST_PARTS:
                break
            place -= 1
        return place
