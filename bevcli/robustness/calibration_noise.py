"""Calibration noise: extrinsics that differ from those with which the images were taken."""

from __future__ import annotations

from dataclasses import replace

from bevcli.frame import Frame, Sequence
from bevcli.geometry.cameras import Camera, CameraRig
from bevcli.geometry.pose_noise import camera_pose_noise
from bevcli.robustness.draws import Draws
from bevcli.robustness.sequences import ChangedSequence


class CalibrationNoise(ChangedSequence):
    """A sequence whose cameras state wrong poses, the same ones for a whole scene.

    `camera_pose_noise` describes the levels.
    """

    def __init__(self, sequence: Sequence, level: int, draws: Draws) -> None:
        super().__init__(sequence)
        self._level, self._draws = level, draws
        self._noisy: tuple[CameraRig, str, CameraRig] | None = None

    def change(self, place: int, frame: Frame) -> Frame:
        """The frame with a noisy rig. Frames of a scene with one rig share one noisy rig."""
        scene = self.scene_key(frame.stamp)
        if self._noisy is None or self._noisy[0] is not frame.rig or self._noisy[1] != scene:
            cameras = tuple(self._with_noise(camera, scene) for camera in frame.rig.cameras)
            self._noisy = (frame.rig, scene, replace(frame.rig, cameras=cameras))
        return replace(frame, rig=self._noisy[2])

    def _with_noise(self, camera: Camera, scene: str) -> Camera:
        noise = camera_pose_noise(self._level, self._draws.generator(scene, camera.name))
        return replace(camera, ego_from_camera=camera.ego_from_camera @ noise)
