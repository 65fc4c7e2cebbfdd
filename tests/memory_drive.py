"""A drive in memory: noise images, a gentle curve, any rig. For tests of everything that comes after the readers."""

from dataclasses import replace

import numpy as np

from bevcli.frame import CameraImage, Drive, Frame, FrameStamp
from bevcli.geometry.cameras import NUSCENES_YAWS_DEG, Camera, CameraRig, default_ego_from_bev
from bevcli.geometry.ego_motion import GRAVITY, Kinematics
from bevcli.geometry.transforms import Pose, rigid, rotation_about_z


def make_camera(name: str, yaw_deg: float, width: int = 320, height: int = 180) -> Camera:
    """A level camera at the vehicle's roof that looks to `yaw_deg`."""
    intrinsics = np.array([[0.8 * width, 0, width / 2], [0, 0.8 * width, height / 2], [0, 0, 1]])
    looking_forward = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    rotation = rotation_about_z(np.radians(yaw_deg)) @ looking_forward
    return Camera(name, width, height, intrinsics, rigid((0.9, 0, 1.6), rotation))


def make_rig(yaws_deg: dict[str, float] | None = None) -> CameraRig:
    """Cameras by name and direction; nuScenes' six by default."""
    yaws_deg = NUSCENES_YAWS_DEG if yaws_deg is None else yaws_deg
    return CameraRig(tuple(make_camera(name, yaw) for name, yaw in yaws_deg.items()), default_ego_from_bev())


class MemoryDrive(Drive):
    """A drive of noise images on a gentle curve, in memory."""

    name = "memory"
    has_ego_motion = True

    def __init__(self, count: int = 4, rig: CameraRig | None = None, scenes: str = "aaaaaaaaaa", step_s: float = 0.5):
        self.rig = make_rig() if rig is None else rig
        self.stamps = tuple(FrameStamp(i, scenes[i], 10**18 + int(i * step_s * 1e9)) for i in range(count))

    def load(self, index: int) -> Frame:
        stamp = self.stamps[index]
        pose = self.pose(index)
        random = np.random.default_rng(index)
        images = {
            camera.name: CameraImage(
                stamp.timestamp_ns, random.integers(0, 256, (camera.height, camera.width, 3), dtype=np.uint8)
            )
            for camera in self.rig.cameras
        }
        return Frame(
            stamp=stamp,
            rig=self.rig,
            images=images,
            world_from_ego=pose,
            world_from_ego_at=dict.fromkeys(self.rig.names, pose),
            kinematics=Kinematics(np.array([0.1, 0.0, GRAVITY]), np.array([0, 0, 0.1]), np.array([6.0, 0, 0])),
        )

    def pose(self, index: int) -> Pose:
        yaw = 0.05 * index
        return Pose(np.array([3.0 * index, 0.1 * index, 0.0]), np.array([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]))


class WithoutImages(MemoryDrive):
    """The same drive, with some images missing: place -> cameras, or "all"."""

    def __init__(self, missing, **options):
        super().__init__(**options)
        self.missing = missing

    def load(self, index: int) -> Frame:
        frame = super().load(index)
        gone = self.missing.get(index, ())
        names = frame.rig.names if gone == "all" else gone
        kept = {name: image for name, image in frame.images.items() if name not in names}
        return replace(frame, images=kept, dropped=dict.fromkeys(names, "missing"))
