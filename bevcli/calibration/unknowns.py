"""The unknowns of a calibration as one vector, and the geometry that follows from them."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bevcli.calibration.options import CalibrateOptions
from bevcli.calibration.views import DELAYS_S, Views
from bevcli.geometry.transforms import Array

Indices = NDArray[np.int64]
OF_CAMERA = 7  # unknowns: rotation, position, delay
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
        motions: (G, 25, 7) ego_b_from_ego_a by group and delay: quaternion (x, y, z, w) and translation.
        groups: (G, 2) pair and camera.
        pairs: number of pairs.
        deviations: (P,) the standard deviation of each unknown before anything is measured.
    """

    stated: Array
    motions: Array
    groups: Indices
    pairs: int
    deviations: Array

    @staticmethod
    def of(views: Views, options: CalibrateOptions) -> "Unknowns":
        """The unknowns of what a drive shows."""
        groups = views.groups()
        motions = []
        for pair, camera in groups:
            matrices = views.motion(pair, camera)
            turns = Rotation.from_matrix(matrices[:, :3, :3]).as_quat(canonical=True)
            turns *= np.sign((turns * turns[:1]).sum(-1, keepdims=True))
            motions.append(np.concatenate([turns, matrices[:, :3, 3]], axis=-1))
        rotation, tilt = np.radians(options.rotation_deg), np.radians(options.tilt_deg)
        camera_deviations = [rotation] * 3 + [options.position_m] * 3 + [options.delay_ms / 1000]
        cameras = len(views.rig.cameras)
        deviations = np.concatenate(
            [
                np.tile(camera_deviations, cameras),
                np.full(OF_PAIR * len(views.pairs), np.radians(options.turn_deg)),
                [options.scale, tilt, tilt],
            ]
        )
        stated = np.stack([camera.ego_from_camera for camera in views.rig.cameras])
        return Unknowns(stated, np.stack(motions), np.array(groups), len(views.pairs), deviations)

    @property
    def cameras(self) -> int:
        """Number of cameras."""
        return len(self.stated)

    @cached_property
    def group_index(self) -> Indices:
        """(K, C) index of the group of a pair and a camera; -1 where there is none."""
        found = np.full((self.pairs, self.cameras), -1)
        found[self.groups[:, 0], self.groups[:, 1]] = np.arange(len(self.groups))
        return found

    def columns(self, group: Indices) -> Indices:
        """(..., 13) the places in x of the unknowns that a group (...,) depends on."""
        pair, camera = self.groups[group].T
        start, rig = OF_CAMERA * self.cameras, OF_CAMERA * self.cameras + OF_PAIR * self.pairs
        parts = [OF_CAMERA * camera[..., None] + np.arange(OF_CAMERA), start + OF_PAIR * pair[..., None] + np.arange(3)]
        parts.append(np.broadcast_to(rig + np.arange(OF_RIG), (*camera.shape, OF_RIG)))
        return np.concatenate(parts, axis=-1)

    def of_camera(self, x: Array) -> Array:
        """(C, 7) rotation, position and delay of each camera."""
        return x[: OF_CAMERA * self.cameras].reshape(self.cameras, OF_CAMERA)

    def ego_from_camera(self, x: Array) -> Array:
        """(C, 4, 4), metres."""
        return moved(self.stated, self.of_camera(x)[:, :6])


def moved(ego_from_camera: Array, change: Array) -> Array:
    """Poses (C, 4, 4) with a change (C, 6): rotation in the camera frame, radians; position in ego, metres."""
    result = ego_from_camera.copy()
    result[:, :3, :3] = ego_from_camera[:, :3, :3] @ Rotation.from_rotvec(change[:, :3]).as_matrix()
    result[:, :3, 3] += change[:, 3:6]
    return result


@dataclass(frozen=True)
class GroupGeometry:
    """The geometry of G groups.

    Attributes:
        ego_from_camera: (G, 4, 4).
        ego_b_from_ego_a: (G, 4, 4) the motion of the vehicle between the two images.
        slopes: (2,) of the road.
    """

    ego_from_camera: Array
    ego_b_from_ego_a: Array
    slopes: Array

    @property
    def camera_b_from_camera_a(self) -> tuple[Array, Array]:
        """Rotations (G, 3, 3) and translations (G, 3)."""
        turn, place = self.ego_from_camera[:, :3, :3], self.ego_from_camera[:, :3, 3:]
        motion, shift = self.ego_b_from_ego_a[:, :3, :3], self.ego_b_from_ego_a[:, :3, 3:]
        back = turn.transpose(0, 2, 1)
        return back @ motion @ turn, (back @ (motion @ place + shift - place))[..., 0]


def geometry(unknowns: Unknowns, local: Array, group: Indices) -> GroupGeometry:
    """The geometry of groups (G,). local: (G, 13), the values of `Unknowns.columns`; the last two are equal in all."""
    camera = unknowns.groups[group, 1]
    poses = moved(unknowns.stated[camera], local[:, :6])
    place = (local[:, 6] - DELAYS_S[0]) / (DELAYS_S[1] - DELAYS_S[0])
    before = np.clip(place.astype(int), 0, len(DELAYS_S) - 2)
    share = (place - before)[:, None]
    motion = (1 - share) * unknowns.motions[group, before] + share * unknowns.motions[group, before + 1]
    motions = np.tile(np.eye(4), (len(group), 1, 1))
    turns = Rotation.from_quat(motion[:, :4]) * Rotation.from_rotvec(local[:, 7:10])
    motions[:, :3, :3] = turns.as_matrix()
    motions[:, :3, 3] = motion[:, 4:] * (1 + local[:, 10:11])
    return GroupGeometry(poses, motions, local[0, 11:13])
