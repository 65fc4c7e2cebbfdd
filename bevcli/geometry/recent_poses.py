"""RecentPoses: the motion of a vehicle now, from its poses until now."""

import numpy as np

from bevcli.geometry.ego_motion import GRAVITY, Kinematics, derive_kinematics
from bevcli.geometry.transforms import Pose


class RecentPoses:
    """The newest poses of a vehicle, from which its motion is derived by differences to earlier times."""

    NEEDED = 3  # for an acceleration
    STEP_NS = 50_000_000  # poses closer than this in time are passed over: their differences are noise
    LONGEST_NS = 2_000_000_000  # older poses say nothing about the motion now

    def __init__(self, poses: tuple[tuple[int, Pose], ...] = ()) -> None:
        """poses: time in ns and world_from_ego, in order."""
        used = list(poses[-1:])
        for pose in reversed(poses):
            if len(used) < self.NEEDED and used[0][0] - pose[0] >= self.STEP_NS:
                used.insert(0, pose)
        self._used = used
        self._kept = poses if len(used) < self.NEEDED else tuple(pose for pose in poses if pose[0] >= used[0][0])

    def with_pose(self, timestamp_ns: int, pose: Pose) -> "RecentPoses":
        """The poses with a later one."""
        recent = (one for one in self._kept if timestamp_ns - one[0] <= self.LONGEST_NS)
        return RecentPoses((*recent, (timestamp_ns, pose)))

    def kinematics(self) -> Kinematics:
        """Acceleration, angular rate and velocity at the last pose."""
        times = np.array([time for time, _ in self._used], dtype=np.int64)
        translations = np.stack([pose.translation for _, pose in self._used])
        quaternions = np.stack([pose.quaternion for _, pose in self._used])
        accelerations, rates, velocities = derive_kinematics(times, translations, quaternions)
        if len(times) < self.NEEDED:
            return Kinematics(accelerations[-1], rates[-1], velocities[-1])
        seconds = np.diff(times) / 1e9
        before, now = np.diff(translations, axis=0) / seconds[:, None]  # world frame, in the middle of each step
        acceleration = (now - before) / seconds.mean() + (0, 0, GRAVITY)
        return Kinematics(self._used[-1][1].matrix[:3, :3].T @ acceleration, rates[-1], velocities[-1])
