"""How far matched points are from where the readings of a rig and of poses put them."""

from collections.abc import Sequence

import cv2
import numpy as np

from bevcli.geometry.transforms import Array, inverse, rigid, rotation_about_z
from bevcli.workshop.correspondence.residuals import EpipolarResiduals, GroupGeometry
from bevcli.workshop.readings.pairs import CameraPair

MOST_PX = 20.0  # a larger residual counts as this
SHORTEST_M = 0.02  # a shorter way of a camera has no direction
PARALLAX_PX = 2.0  # from which a point tells on which side of the camera it is
ASSUMED_M = 3.0  # way of a vehicle between two frames without poses


class MatchedPoints:
    """The matched points of pairs of images."""

    def __init__(self, pairs: Sequence[CameraPair]) -> None:
        counts = [len(pair.rays_a) for pair in pairs]
        self.pairs = pairs
        self._bounds = np.concatenate([[0], np.cumsum(counts)])
        self._points = EpipolarResiduals(
            np.repeat(np.arange(len(pairs)), counts),
            np.concatenate([pair.rays_a for pair in pairs]),
            np.concatenate([pair.rays_b for pair in pairs]),
            np.repeat([pair.camera.intrinsics[0, 0] for pair in pairs], counts),
        )

    def residual_px(self, ego_from_camera: Array, ego_b_from_ego_a: Array) -> float:
        """The mean of the pairs' median residuals, reduced pixels. Arguments: (P, 4, 4), of each pair."""
        points, medians = self._points, []
        geometry = GroupGeometry(ego_from_camera, ego_from_camera, ego_b_from_ego_a, np.zeros(2))
        off = np.abs(points.of(geometry)[:, 0])
        relative = geometry.camera_b_from_camera_a[points.group]
        turned = np.einsum("nij,nj->ni", relative[:, :3, :3], points.rays_a)
        parallax = points.focal * np.linalg.norm(np.cross(turned, points.rays_b), axis=-1)
        behind = (points.depths(geometry) < 0).any(-1) & (parallax > PARALLAX_PX)
        stays = np.linalg.norm(relative[:, :3, 3], axis=-1) < SHORTEST_M
        off = np.where(behind | stays | ((turned * points.rays_b).sum(-1) < 0), np.maximum(off, parallax), off)
        for start, end in zip(self._bounds, self._bounds[1:], strict=False):
            medians.append(min(float(np.median(off[start:end])), MOST_PX))
        return float(np.mean(medians))

    def motions_seen(self, ego_from_camera: Array) -> Array:
        """(P, 4, 4) ego_b_from_ego_a by the images alone: a vehicle that drives along an arc."""
        motions = np.broadcast_to(np.eye(4), (len(self.pairs), 4, 4)).copy()
        for number in {pair.pair for pair in self.pairs}:
            mine = [index for index, pair in enumerate(self.pairs) if pair.pair == number]
            best = max(mine, key=lambda index: len(self.pairs[index].rays_a))
            turn = ego_from_camera[best][:3, :3] @ rotation_seen(self.pairs[best]) @ ego_from_camera[best][:3, :3].T
            yaw = float(np.arctan2(turn[1, 0], turn[0, 0]))
            ways = (rigid(-way * rotation_about_z(yaw / 2)[:, 0], turn) for way in (ASSUMED_M, -ASSUMED_M))
            some = MatchedPoints([self.pairs[index] for index in mine])
            repeated = [np.broadcast_to(way, (len(mine), 4, 4)) for way in ways]
            motions[mine] = min(repeated, key=lambda way: some.residual_px(ego_from_camera[mine], way))
        return motions


def rotation_seen(pair: CameraPair) -> Array:
    """(3, 3) camera_b_from_camera_a by the matched points."""
    flat_a, flat_b = (rays[:, :2] / rays[:, 2:] for rays in (pair.rays_a, pair.rays_b))
    threshold = 1 / pair.camera.intrinsics[0, 0]
    essential, inliers = cv2.findEssentialMat(flat_a, flat_b, np.eye(3), cv2.RANSAC, 0.999, threshold)
    if essential is None or essential.shape != (3, 3):
        return np.eye(3)
    _, rotation, _, _ = cv2.recoverPose(essential, flat_a, flat_b, np.eye(3), mask=inliers)
    return np.asarray(rotation, dtype=np.float64)


def body_motions(poses: Array) -> Array:
    """(P, 4, 4) body_b_from_body_a of poses (P, 2, 4, 4), world_from_body at the times of both images."""
    return inverse(poses[:, 1]) @ poses[:, 0]
