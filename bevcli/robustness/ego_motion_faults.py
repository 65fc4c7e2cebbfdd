"""Faults of times and ego-motion: cameras with wrong capture times, and poses that do not arrive."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from bevcli.frame import Frame, Sequence
from bevcli.geometry.ego_motion import Kinematics
from bevcli.geometry.transforms import Array, Pose, inverse, rigid
from bevcli.robustness.draws import Draws
from bevcli.robustness.sequences import ChangedSequence

POSE_LOST_PARTS = 6  # level L loses a pose with probability L/6


class TimeOffsets(ChangedSequence):
    """A sequence whose cameras state wrong capture times: each camera is off by its own constant, for a whole scene.

    Level L draws each offset uniformly from -L to L milliseconds. The pose of the vehicle at the camera's time is then
    that of the wrong time: the vehicle is moved on with the frame's velocity and angular rate. Images stay.
    """

    def __init__(self, sequence: Sequence, level: int, draws: Draws) -> None:
        super().__init__(sequence)
        self._level, self._draws = level, draws

    def change(self, place: int, frame: Frame) -> Frame:
        """The frame with wrong times and the poses at these times."""
        scene = self.scene_key(frame.stamp)
        offsets_s = {
            name: self._level / 1000 * self._draws.generator(scene, name).uniform(-1, 1) for name in frame.rig.names
        }
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

    def __init__(self, sequence: Sequence, level: int, draws: Draws) -> None:
        super().__init__(sequence)
        self._level, self._draws = level, draws
        self._arrived: dict[int, tuple[Pose, Kinematics]] = {}

    def change(self, place: int, frame: Frame) -> Frame:
        """The frame with the last pose that arrived."""
        last = self._last_arrived(place)
        if last == place:
            self._arrived[place] = frame.world_from_ego, frame.kinematics
            return frame
        if last not in self._arrived:
            earlier = self._sequence.load(last)
            self._arrived[last] = earlier.world_from_ego, earlier.kinematics
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
            random = self._draws.generator(self.scene_key(stamps[place]), stamps[place].index)
            if random.random() >= self._level / POSE_LOST_PARTS:
                break
            place -= 1
        return place


def motion_during(seconds: float, kinematics: Kinematics) -> Array:
    """(4, 4) ego_from_later_ego: the motion of the vehicle during a time with constant velocity and angular rate.

    seconds: negative for an earlier time.
    """
    turn, _ = cv2.Rodrigues(seconds * kinematics.angular_rate)
    half_turn, _ = cv2.Rodrigues(seconds / 2 * kinematics.angular_rate)
    return rigid(half_turn @ (seconds * np.asarray(kinematics.velocity)), turn)
