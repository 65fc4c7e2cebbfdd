"""The unknowns of a calibration as one vector, and the geometry that follows from them."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bevcli.geometry.transforms import Array, inverse
from bevcli.workshop.calibration.options import CalibrateOptions
from bevcli.workshop.calibration.views import DELAYS_S, Views

Indices = NDArray[np.int64]
OF_CAMERA = 7  # unknowns: rotation, position, delay
HEIGHT = 5  # place of a camera's height among them
OF_PAIR = 3  # the error of the vehicle's rotation
OF_RIG = 3  # scale of the ego-motion, slope of the road along x and y


@dataclass(frozen=True)
class Unknowns:
    """The layout of the vector of unknowns, x, and the stated values from which it counts.

    x holds for each camera its rotation (3, radians, in the camera frame), position (3, metres, in the ego frame) and
    delay (seconds); for each pair the rotation of the vehicle (3, radians); at last the scale of the ego-motion (a
    share), and the slopes of the road along x and y of the ego frame.

    Attributes:
        stated: (C, 4, 4) ego_from_camera.
        poses: (G, 2, 25, 7) world_from_ego of both images of a group, by delay: quaternion (x, y, z, w), translation.
        groups: (G, 3) pair, camera of the first image and camera of the second one.
        pairs: number of pairs.
        deviations: (P,) the standard deviation of each unknown before anything is measured.
    """

    stated: Array
    poses: Array
    groups: Indices
    pairs: int
    deviations: Array

    @staticmethod
    def of(views: Views, options: CalibrateOptions) -> "Unknowns":
        """The unknowns of what a drive shows."""
        groups = views.groups()
        poses = np.stack([[_quaternions(view.poses) for view in views.sides(group)] for group in groups])
        poses[..., 4:] -= poses[:, :1, :1, 4:]
        rotation, tilt = np.radians(options.rotation_deg), np.radians(options.tilt_deg)
        camera_deviations = [rotation] * 3 + [options.position_m] * 3 + [options.delay_ms / 1000]
        cameras = len(views.rig.cameras)
        of_cameras = np.tile(camera_deviations, cameras)
        of_pairs = np.full(OF_PAIR * len(views.pairs), np.radians(options.turn_deg))
        deviations = np.concatenate([of_cameras, of_pairs, [options.scale, tilt, tilt]])
        stated = np.stack([camera.ego_from_camera for camera in views.rig.cameras])
        return Unknowns(stated, poses, np.array(groups), len(views.pairs), deviations)

    @property
    def cameras(self) -> int:
        """Number of cameras."""
        return len(self.stated)

    @cached_property
    def within_camera(self) -> Indices:
        """The groups whose images are of the same camera."""
        return np.flatnonzero(self.groups[:, 1] == self.groups[:, 2])

    @cached_property
    def columns(self) -> Indices:
        """(G, 20) the places in x of the unknowns that a group depends on: two cameras, the pair, and the rig."""
        pair, first, second = self.groups.T[..., None]
        start, rig = OF_CAMERA * self.cameras, OF_CAMERA * self.cameras + OF_PAIR * self.pairs
        of_rig = np.broadcast_to(rig + np.arange(OF_RIG), (len(self.groups), OF_RIG))
        cameras = [OF_CAMERA * each + np.arange(OF_CAMERA) for each in (first, second)]
        return np.concatenate([*cameras, start + OF_PAIR * pair + np.arange(OF_PAIR), of_rig], axis=-1)

    def of_camera(self, x: Array) -> Array:
        """(C, 7) rotation, position and delay of each camera."""
        return x[: OF_CAMERA * self.cameras].reshape(self.cameras, OF_CAMERA)

    def ego_from_camera(self, x: Array) -> Array:
        """(C, 4, 4), metres."""
        return moved(self.stated, self.of_camera(x))


def moved(ego_from_camera: Array, change: Array) -> Array:
    """Poses (C, 4, 4) with a change (C, 6 or 7): rotation in the camera frame, radians; position in ego, metres."""
    result = ego_from_camera.copy()
    result[:, :3, :3] = ego_from_camera[:, :3, :3] @ Rotation.from_rotvec(change[:, :3]).as_matrix()
    result[:, :3, 3] += change[:, 3:6]
    return result


def _quaternions(poses: Array) -> Array:
    """Poses (25, 4, 4) as quaternions of one sign and translations, (25, 7)."""
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    turns *= np.sign((turns * turns[:1]).sum(-1, keepdims=True))
    return np.concatenate([turns, poses[:, :3, 3]], axis=-1)


@dataclass(frozen=True)
class GroupGeometry:
    """The geometry of all groups.

    Attributes:
        ego_from_camera_a: (G, 4, 4).
        ego_from_camera_b: (G, 4, 4).
        ego_b_from_ego_a: (G, 4, 4) the motion of the vehicle between the two images.
        slopes: (2,) of the road.
    """

    ego_from_camera_a: Array
    ego_from_camera_b: Array
    ego_b_from_ego_a: Array
    slopes: Array

    @property
    def camera_b_from_camera_a(self) -> Array:
        """(G, 4, 4)."""
        return inverse(self.ego_from_camera_b) @ self.ego_b_from_ego_a @ self.ego_from_camera_a


def geometry_at(unknowns: Unknowns, x: Array) -> GroupGeometry:
    """The geometry of all groups for the values x (P,)."""
    return geometry(unknowns, x[unknowns.columns])


def geometry(unknowns: Unknowns, local: Array) -> GroupGeometry:
    """The geometry of all groups. local: (G, 20), the values of `Unknowns.columns`."""
    of_a, of_b, pair, rig = np.split(local, np.cumsum([OF_CAMERA, OF_CAMERA, OF_PAIR]), axis=-1)
    (_, first, second), stated = unknowns.groups.T, unknowns.stated
    before, after = (_pose_at(unknowns.poses[:, side], each[:, 6]) for side, each in enumerate((of_a, of_b)))
    motion = inverse(after) @ before
    motion[:, :3, :3] = motion[:, :3, :3] @ Rotation.from_rotvec(pair).as_matrix()
    motion[:, :3, 3] *= 1 + rig[:, :1]
    return GroupGeometry(moved(stated[first], of_a), moved(stated[second], of_b), motion, rig[0, 1:])


def _pose_at(table: Array, delay: Array) -> Array:
    """(G, 4, 4) poses of tables (G, 25, 7) at delays (G,), seconds."""
    place = (delay - DELAYS_S[0]) / (DELAYS_S[1] - DELAYS_S[0])
    before = np.clip(place.astype(int), 0, len(DELAYS_S) - 2)
    share, every = (place - before)[:, None], np.arange(len(table))
    pose = (1 - share) * table[every, before] + share * table[every, before + 1]
    result = np.tile(np.eye(4), (len(table), 1, 1))
    result[:, :3, :3] = Rotation.from_quat(pose[:, :4]).as_matrix()
    result[:, :3, 3] = pose[:, 4:]
    return result
