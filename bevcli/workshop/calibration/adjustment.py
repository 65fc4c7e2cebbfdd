"""The unknowns of a calibration as one vector, and the geometry of all groups for its values."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bevcli.geometry.transforms import Array, inverse
from bevcli.workshop.correspondence.residuals import GroupGeometry, Indices
from bevcli.workshop.correspondence.solver import Solution

OF_CAMERA = 7  # unknowns: rotation, position, delay
HEIGHT = 5  # index of a camera's height among them
OF_PAIR = 3  # the error of the vehicle's rotation; or of lenses
OF_RIG = 3  # scale of the ego-motion, slope of the road along x and y
DELAYS_S = np.linspace(-0.3, 0.3, 25)  # of a camera's capture times, where the motion of a pair is tabulated


@dataclass(frozen=True)
class Unknowns:
    """The layout of the vector of unknowns, x, and the stated values from which it counts.

    x holds for each camera its rotation (3, radians, in the camera frame), position (3, metres, in the ego frame) and
    delay (seconds); for each pair the rotation of the vehicle (3, radians); for each two neighbours the rotation that
    errors of their lenses look like at one time (3, radians, in the ego frame); at last the scale of the ego-motion (a
    share), and the slopes of the road along x and y of the ego frame. Poses are quaternions (x, y, z, w) and
    translations.
    """

    stated: Array  # (C, 4, 4) ego_from_camera
    poses: Array  # (G, 2, 25, 7) world_from_ego of both images of a group, by delay
    groups: Indices  # (G, 3) pair, camera of the first image and camera of the second one
    turns: Indices  # (G,) the rotation that the group depends on: that of its pair, or else of its two cameras
    pairs: int
    neighbours: int  # pairs of neighbours
    deviations: Array  # (P,) the standard deviation of each unknown before anything is measured

    @property
    def cameras(self) -> int:
        """Number of cameras."""
        return len(self.stated)

    @cached_property
    def within_camera(self) -> Indices:
        """The groups whose images are of the same camera."""
        return np.flatnonzero(self.groups[:, 1] == self.groups[:, 2])

    @cached_property
    def moves(self) -> NDArray[np.bool_]:
        """(G,) whether the images of a group are of both frames of its pair; else both are of the first one."""
        return np.asarray(self.turns < self.pairs)

    @cached_property
    def columns(self) -> Indices:
        """(G, 20) the indices in x of the unknowns that a group depends on: two cameras, the pair, and the rig."""
        _, first, second = self.groups.T[..., None]
        start = OF_CAMERA * self.cameras
        rig = start + OF_PAIR * (self.pairs + self.neighbours)
        of_rig = np.broadcast_to(rig + np.arange(OF_RIG), (len(self.groups), OF_RIG))
        cameras = [OF_CAMERA * index + np.arange(OF_CAMERA) for index in (first, second)]
        return np.concatenate([*cameras, start + OF_PAIR * self.turns[:, None] + np.arange(OF_PAIR), of_rig], axis=-1)

    def of_camera(self, x: Array) -> Array:
        """(C, 7) rotation, position and delay of each camera."""
        return x[: OF_CAMERA * self.cameras].reshape(self.cameras, OF_CAMERA)

    def geometry(self, local: Array) -> GroupGeometry:
        """The geometry of all groups. local: (G, 20), the values of `columns`."""
        of_a, of_b, turn, rig = np.split(local, np.cumsum([OF_CAMERA, OF_CAMERA, OF_PAIR]), axis=-1)
        (_, first, second), ego_from_camera = self.groups.T, self.stated
        before, after = (_pose_at(self.poses[:, side], camera[:, 6]) for side, camera in enumerate((of_a, of_b)))
        motion = inverse(after) @ before
        motion[:, :3, :3] = motion[:, :3, :3] @ Rotation.from_rotvec(turn * self.moves[:, None]).as_matrix()
        motion[:, :3, 3] *= 1 + rig[:, :1]
        pose_a, pose_b = moved(ego_from_camera[first], of_a), moved(ego_from_camera[second], of_b)
        pose_a[:, :3, :3] = Rotation.from_rotvec(turn * ~self.moves[:, None]).as_matrix() @ pose_a[:, :3, :3]
        return GroupGeometry(pose_a, pose_b, motion, rig[0, 1:])


def moved(ego_from_camera: Array, change: Array) -> Array:
    """Poses (C, 4, 4) with a change (C, 6 or 7): rotation in the camera frame, radians; position in ego, metres."""
    result = ego_from_camera.copy()
    result[:, :3, :3] = ego_from_camera[:, :3, :3] @ Rotation.from_rotvec(change[:, :3]).as_matrix()
    result[:, :3, 3] += change[:, 3:6]
    return result


def _pose_at(table: Array, delay: Array) -> Array:
    """(G, 4, 4) poses of tables (G, 25, 7) at delays (G,), seconds."""
    index = (delay - DELAYS_S[0]) / (DELAYS_S[1] - DELAYS_S[0])
    before = np.clip(index.astype(int), 0, len(DELAYS_S) - 2)
    share, every = (index - before)[:, None], np.arange(len(table))
    pose = (1 - share) * table[every, before] + share * table[every, before + 1]
    result = np.tile(np.eye(4), (len(table), 1, 1))
    result[:, :3, :3] = Rotation.from_quat(pose[:, :4]).as_matrix()
    result[:, :3, 3] = pose[:, 4:]
    return result


SMALLEST_TURN = np.radians(0.005)  # of it


def with_estimated_turns(unknowns: Unknowns, solution: Solution) -> Unknowns:
    """The unknowns with the deviation of the vehicle's stated rotation that its pairs show, at most the present one.

    It is estimated an axis, as the scatter of the solution over what the pairs determine (MacKay's rule).
    """
    deviations = unknowns.deviations.copy()
    start = OF_CAMERA * unknowns.cameras
    turns = slice(start, start + OF_PAIR * unknowns.pairs)
    covariance = np.linalg.inv(solution.information + np.diag(1 / deviations**2))
    determined = (1 - np.diag(covariance)[turns] / deviations[turns] ** 2).reshape(-1, OF_PAIR).sum(0)
    squares = (solution.x[turns] ** 2).reshape(-1, OF_PAIR).sum(0)
    estimated = np.maximum(np.sqrt(squares / np.maximum(determined, 1)), SMALLEST_TURN)
    deviations[turns] = np.minimum(deviations[turns], np.tile(estimated, unknowns.pairs))
    return replace(unknowns, deviations=deviations)
