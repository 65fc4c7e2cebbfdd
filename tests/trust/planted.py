"""Drives with one planted fault each, and the table of which ones `find_faults` finds without labels."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from bevcli.frame import CameraImage, DerivedSequence, Frame, Sequence
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.transforms import Pose, rigid


class Planted(DerivedSequence):
    """A drive whose frames are changed when they are loaded."""

    def __init__(self, drive: Sequence, change: Callable[[Sequence, int, Frame], Frame], rig: CameraRig | None = None):
        super().__init__(drive)
        self.change, self.rig = change, rig or drive.rig

    def load(self, place: int) -> Frame:
        return replace(self.change(self.sequence, place, self.sequence.load(place)), rig=self.rig)


def with_pixels(image: CameraImage, pixels) -> CameraImage:
    return replace(image, pixels_bgr=np.ascontiguousarray(pixels), encoded=None, media_type=None)


def _image(change):
    """Changes the image of one camera. change: (drive, place, camera, image) -> image."""

    def plant(drive: Sequence, camera: str) -> Sequence:
        def changed(sequence, place, frame):
            return replace(
                frame, images={**frame.images, camera: change(sequence, place, camera, frame.images[camera])}
            )

        return Planted(drive, changed)

    return plant


def _turned(axis_deg):
    """One camera states another rotation. axis_deg: about its right, down and forward axes."""

    def plant(drive: Sequence, camera: str) -> Sequence:
        from scipy.spatial.transform import Rotation

        turn = rigid(rotation=Rotation.from_rotvec(axis_deg, degrees=True).as_matrix())
        return with_camera(drive, camera, lambda one: replace(one, ego_from_camera=one.ego_from_camera @ turn))

    return plant


def with_camera(drive: Sequence, camera: str, change) -> Sequence:
    cameras = tuple(change(one) if one.name == camera else one for one in drive.rig.cameras)
    return Planted(drive, lambda sequence, place, frame: frame, replace(drive.rig, cameras=cameras))


def longer_focal(drive: Sequence, camera: str, factor: float = 1.15) -> Sequence:
    """One camera states a focal length that is too long."""
    scale = np.array([[factor, 1, 1], [1, factor, 1], [1, 1, 1]])
    return with_camera(drive, camera, lambda one: replace(one, intrinsics=one.intrinsics * scale))


def exchanged(drive: Sequence, camera: str, other: str) -> Sequence:
    """The images of two cameras are exchanged."""

    def change(sequence, place, frame):
        images = dict(frame.images)
        images[camera], images[other] = images[other], images[camera]
        return replace(frame, images=images)

    return Planted(drive, change)


def late(drive: Sequence, camera: str) -> Sequence:
    """The images of one camera are those of the frame before."""

    def change(sequence, place, frame):
        before = sequence.load(max(place - 1, 0)).images[camera]
        image = replace(before, timestamp_ns=frame.images[camera].timestamp_ns)
        return replace(frame, images={**frame.images, camera: image})

    return Planted(drive, change)


black = _image(lambda drive, place, camera, image: with_pixels(image, np.zeros_like(image.pixels_bgr)))
frozen = _image(lambda drive, place, camera, image: with_pixels(image, drive.load(0).images[camera].pixels_bgr))
mirrored = _image(lambda drive, place, camera, image: with_pixels(image, image.pixels_bgr[:, ::-1]))
yawed, pitched = _turned((0, 2.0, 0)), _turned((2.0, 0, 0))


def wrong_channels(drive: Sequence) -> Sequence:
    """All images have the channels of RGB in place of BGR."""

    def change(sequence, place, frame):
        images = {name: with_pixels(one, one.pixels_bgr[..., ::-1]) for name, one in frame.images.items()}
        return replace(frame, images=images)

    return Planted(drive, change)


class OtherPoses(DerivedSequence):
    """A drive whose poses are changed. change: positions (T, 3) and rotations (T, 3, 3) -> the same of other poses."""

    def __init__(self, drive: Sequence, change) -> None:
        super().__init__(drive)
        motion = drive.ego_motion
        assert motion is not None
        self._change, self._start = change, motion.translations[0]
        matrices = [Pose(t, q).matrix for t, q in zip(motion.translations, motion.quaternions, strict=True)]
        poses = [self._changed(matrix) for matrix in matrices]
        self.ego_motion = replace(
            motion,
            translations=np.stack([pose.translation for pose in poses]),
            quaternions=np.stack([pose.quaternion for pose in poses]),
        )

    def _changed(self, matrix) -> Pose:
        return Pose.from_matrix(self._change(self._start, matrix))

    def load(self, place: int) -> Frame:
        frame = self.sequence.load(place)
        at = {name: self._changed(pose.matrix) for name, pose in frame.world_from_ego_at.items()}
        return replace(frame, world_from_ego=self._changed(frame.world_from_ego.matrix), world_from_ego_at=at)


def scaled_poses(drive: Sequence, factor: float = 3.6) -> Sequence:
    """Positions from speeds in km/h that were taken for m/s."""
    return OtherPoses(drive, lambda start, pose: rigid(start + factor * (pose[:3, 3] - start), pose[:3, :3]))


def mirrored_poses(drive: Sequence) -> Sequence:
    """Poses of a left-handed world: y is mirrored."""
    flip = np.diag([1.0, -1, 1])
    return OtherPoses(drive, lambda start, pose: rigid(flip @ pose[:3, 3], flip @ pose[:3, :3] @ flip))


def lost_poses(drive: Sequence) -> Sequence:
    """Poses that stand still."""
    return OtherPoses(drive, lambda start, pose: rigid(start))
