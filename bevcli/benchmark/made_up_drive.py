"""A drive for timing: six cameras around a moving vehicle, their images made here and kept as JPEG in memory."""

from __future__ import annotations

import cv2
import numpy as np

from bevcli.frame import CameraImage, Frame, FrameStamp
from bevcli.geometry.cameras import Camera, CameraRig, default_ego_from_bev
from bevcli.geometry.ego_motion import GRAVITY, Kinematics
from bevcli.geometry.transforms import Pose, rigid, rotation_about_z
from bevcli.pipeline.camera_assignment import NUSCENES_YAWS_DEG

WIDTH, HEIGHT = 1600, 900
FOCAL_LENGTH = 1266.0  # pixels, of nuScenes' cameras but the one that looks back
BACK_FOCAL_LENGTH = 809.0
STEP_S = 0.5
SPEED = 8.0  # m/s
KEPT_IMAGES = 12  # JPEGs in memory; frames and cameras take turns


class MadeUpDrive:
    """A `Sequence` of any length. Directions and lenses are those of nuScenes, so that as many cells are seen."""

    name = "made-up"
    notes: tuple[str, ...] = ()
    has_ego_motion = True

    def __init__(self, frames: int) -> None:
        self.rig = CameraRig(tuple(map(_camera, NUSCENES_YAWS_DEG)), default_ego_from_bev())
        self.stamps = tuple(FrameStamp(i, "", 10**18 + int(i * STEP_S * 1e9)) for i in range(frames))
        self._files = [_jpeg(seed) for seed in range(KEPT_IMAGES)]

    def load(self, place: int) -> Frame:
        """The frame at a place, its six images decoded anew."""
        stamp, pose = self.stamps[place], _pose(place * STEP_S)
        return Frame(
            stamp=stamp,
            rig=self.rig,
            images={name: self._image(place * len(self.rig.names) + i, stamp) for i, name in enumerate(self.rig.names)},
            world_from_ego=pose,
            world_from_ego_at=dict.fromkeys(self.rig.names, pose),
            kinematics=Kinematics(np.array([0, 0, GRAVITY]), np.array([0, 0, 0.05]), np.array([SPEED, 0, 0])),
        )

    def _image(self, number: int, stamp: FrameStamp) -> CameraImage:
        encoded = self._files[number % KEPT_IMAGES]
        pixels = cv2.imdecode(np.frombuffer(encoded, dtype=np.uint8), cv2.IMREAD_COLOR)
        assert pixels is not None
        return CameraImage(stamp.timestamp_ns, pixels.astype(np.uint8, copy=False), encoded, "image/jpeg")


def _camera(name: str) -> Camera:
    focal_length = BACK_FOCAL_LENGTH if name == "CAM_BACK" else FOCAL_LENGTH
    intrinsics = np.array([[focal_length, 0, WIDTH / 2], [0, focal_length, 0.55 * HEIGHT], [0, 0, 1]])
    looking_forward = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    turned = rotation_about_z(np.radians(NUSCENES_YAWS_DEG[name]))
    place = turned @ (0.8, 0, 0) + (0.9, 0, 1.5)
    return Camera(name, WIDTH, HEIGHT, intrinsics, rigid(place, turned @ looking_forward))


def _pose(seconds: float) -> Pose:
    yaw = 0.05 * seconds
    return Pose(np.array([SPEED * seconds, 0.2 * seconds, 0]), np.array([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]))


def _jpeg(seed: int) -> bytes:
    """Shapes of all sizes and some noise: about as many bytes as a street."""
    random = np.random.default_rng(seed)
    layers = [random.normal(0, 60 / (i + 1), (9 * 2**i, 16 * 2**i, 3)).astype(np.float32) for i in range(5)]
    image = 110 + sum(cv2.resize(layer, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC) for layer in layers)
    encoded = cv2.imencode(".jpg", np.clip(image, 0, 255).astype(np.uint8))[1]
    return encoded.tobytes()
