"""What several tests need: a tiny model, a drive in memory, and where the shared reference data lie."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from bevcli.frame import Frame, FrameStamp, Picture
from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.boxes import CLASSES
from bevcli.geometry.cameras import Camera, CameraRig, default_ego_from_bev
from bevcli.geometry.ego_motion import GRAVITY, Kinematics
from bevcli.geometry.transforms import Pose, rigid, rotation_about_z
from bevcli.model.bevformer import BEVFormer, BEVFormerConfig
from bevcli.model.decoder import DecoderConfig
from bevcli.model.encoder import EncoderConfig
from bevcli.model.image_config import ImageConfig
from bevcli.model.resnet import ResNetConfig
from bevcli.pipeline.camera_assignment import NUSCENES_YAWS_DEG


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of real frames and reference numbers; skips where there is none."""
    folder = os.environ.get("BEVCLI_SHARED")
    if not folder:
        pytest.skip("BEVCLI_SHARED is not set: no real frames and reference numbers here")
    return Path(folder)


@pytest.fixture(scope="session")
def mini_config() -> BEVFormerConfig:
    """BEVFormer with all parts, so small that a step takes milliseconds."""
    return BEVFormerConfig(
        name="mini",
        classes=CLASSES,
        cameras=tuple(NUSCENES_YAWS_DEG),
        image=ImageConfig(size=(160, 90), mean=(123.0, 116.0, 103.0), std=(58.0, 57.0, 57.0), color_order="rgb"),
        bev_grid=BevGrid(rows=12, columns=10, x_range_m=(-25, 25), y_range_m=(-30, 30)),
        channels=32,
        backbone=ResNetConfig(blocks=(1, 1, 1, 1), width=8),
        encoder=EncoderConfig(layers=2, attention_heads=4, feed_forward_width=64),
        decoder=DecoderConfig(layers=2, attention_heads=4, queries=30, feed_forward_width=64, max_boxes=20),
    )


@pytest.fixture(scope="session")
def mini_model(mini_config) -> BEVFormer:
    """Untrained, always the same, and awake: attention weights and residual branches are not zero."""
    torch.manual_seed(0)
    model = BEVFormer(mini_config).eval()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    return model


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


class MemorySequence:
    """A drive of noise pictures on a gentle curve, in memory, as a `Sequence`."""

    name = "memory"
    notes = ()
    has_ego_motion = True

    def __init__(self, count: int = 4, rig: CameraRig | None = None, scenes: str = "aaaaaaaaaa", step_s: float = 0.5):
        self.rig = make_rig() if rig is None else rig
        self.stamps = tuple(FrameStamp(i, scenes[i], 10**18 + int(i * step_s * 1e9)) for i in range(count))

    def load(self, place: int) -> Frame:
        stamp = self.stamps[place]
        pose = self.pose(place)
        random = np.random.default_rng(place)
        pictures = {
            camera.name: Picture(
                stamp.timestamp_ns, random.integers(0, 256, (camera.height, camera.width, 3), dtype=np.uint8)
            )
            for camera in self.rig.cameras
        }
        return Frame(
            stamp=stamp,
            rig=self.rig,
            pictures=pictures,
            world_from_ego=pose,
            world_from_ego_at=dict.fromkeys(self.rig.names, pose),
            kinematics=Kinematics(np.array([0.1, 0.0, GRAVITY]), np.array([0, 0, 0.1]), np.array([6.0, 0, 0])),
        )

    def pose(self, place: int) -> Pose:
        yaw = 0.05 * place
        return Pose(np.array([3.0 * place, 0.1 * place, 0.0]), np.array([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]))


class WithoutPictures(MemorySequence):
    """The same drive, with some pictures missing: place -> cameras, or "all"."""

    def __init__(self, missing, **options):
        super().__init__(**options)
        self.missing = missing

    def load(self, place: int) -> Frame:
        frame = super().load(place)
        gone = self.missing.get(place, ())
        names = frame.rig.names if gone == "all" else gone
        kept = {name: picture for name, picture in frame.pictures.items() if name not in names}
        return replace(frame, pictures=kept, dropped=dict.fromkeys(names, "missing"))
