"""Drives of two cameras in memory: boxes are drawn as coloured shapes on grey ground."""

from dataclasses import replace

import cv2
import numpy as np
from memory_drive import make_rig

from bevcli.frame import BevMap, CameraImage, Drive, Frame, FrameStamp
from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import Camera
from bevcli.geometry.ego_motion import GRAVITY, Kinematics
from bevcli.geometry.transforms import Pose, apply, inverse
from bevcli.model.config import ImageConfig, ModelConfig
from bevcli.model.decoder import DecoderConfig
from bevcli.model.encoder import EncoderConfig
from bevcli.model.resnet import ResNetConfig
from bevcli.model.segmentation import SegmentationConfig
from bevcli.workshop.training.augmentation import AugmentationConfig
from bevcli.workshop.training.samples import Batch, BatchMaker, Clip, ClipConfig, joined

COLORS = {"car": (40, 60, 220), "pedestrian": (60, 200, 60)}
SIZES = {"car": (4.5, 2.0, 1.6), "pedestrian": (0.8, 0.8, 1.8)}
RIG = make_rig({"CAM_FRONT": 0.0, "CAM_BACK": 180.0})
REACH_M = 16.0
CONFIG = ModelConfig(
    name="painted",
    classes=tuple(COLORS),
    cameras=RIG.names,
    image=ImageConfig((128, 72), mean=(110, 110, 110), std=(60, 60, 60), color_order="rgb"),
    bev_grid=BevGrid(12, 12, (-REACH_M, REACH_M), (-REACH_M, REACH_M), (-3, 2), 4),
    channels=32,
    heads=("detection", "segmentation"),
    backbone=ResNetConfig((1, 1, 1, 1), width=8, output_stages=(3,)),
    encoder=EncoderConfig(1, attention_heads=4, temporal_points=2, spatial_points=4, feed_forward_width=64, dropout=0),
    decoder=DecoderConfig(2, attention_heads=4, queries=20, feed_forward_width=64, dropout=0, max_boxes=20),
    segmentation=SegmentationConfig(8, 1, 1, attention_heads=4, feed_forward_width=64, dropout=0),
)


class PaintedDrive(Drive):
    """Two frames half a second apart, with three cars and two pedestrians.

    all_labelled: whether both frames have ground truth, or only the second.
    """

    has_ego_motion = True
    rig = RIG

    def __init__(self, seed: int, *, all_labelled: bool) -> None:
        self._all_labelled = all_labelled
        self.name = f"painted-{seed}"
        self.stamps = tuple(FrameStamp(i, self.name, 10**18 + i * 500_000_000) for i in range(2))
        self._boxes = _boxes(np.random.default_rng(seed))  # in the world frame, the bev frame of the second frame

    def load(self, index: int) -> Frame:
        """The frame at an index. Only the ego vehicle moves, 1 m forward."""
        pose = Pose(np.array([float(index - 1), 0, 0]), np.array([1.0, 0, 0, 0]))
        stamp = self.stamps[index]
        images = {c.name: CameraImage(stamp.timestamp_ns, self._image(c, pose)) for c in RIG.cameras}
        still = Kinematics(np.array([0, 0, GRAVITY]), np.zeros(3), np.array([2.0, 0, 0]))
        frame = Frame(stamp, RIG, images, pose, dict.fromkeys(RIG.names, pose), still)
        labels = {"ground_truth": self._boxes, "ground_truth_map": _map()}
        return replace(frame, **(labels if index or self._all_labelled else {}))

    def _image(self, camera: Camera, pose: Pose) -> np.ndarray:
        pixels = np.full((camera.height, camera.width, 3), 120, dtype=np.uint8)
        pixels[: camera.height // 2] = 200
        camera_from_world = camera.camera_from_ego @ inverse(pose.matrix)
        nearest_last = np.argsort(-np.hypot(*self._boxes.centers[:, :2].T))
        for box in nearest_last:
            corners = apply(camera_from_world, self._boxes[[box]].corners()[0])
            if (corners[:, 2] > 0.5).all():
                outline = cv2.convexHull(camera.project(corners)[0].astype(np.float32)).astype(np.int32)
                cv2.fillPoly(pixels, [outline], COLORS[str(self._boxes.classes[box])])
        return pixels


class PaintedDrives:
    """Painted drives of the seeds 0 to count - 1."""

    input_shapes = None

    def __init__(self, count: int, *, all_labelled: bool = False) -> None:
        self._drives = [PaintedDrive(seed, all_labelled=all_labelled) for seed in range(count)]

    def __len__(self) -> int:
        return len(self._drives)

    def open(self, index: int) -> PaintedDrive:
        """The drive at an index."""
        return self._drives[index]


def _boxes(random: np.random.Generator) -> Boxes3D:
    classes = np.array(["car"] * 3 + ["pedestrian"] * 2)
    ahead = random.uniform(5, 14, len(classes)) * np.where(random.random(len(classes)) < 0.5, 1, -1)
    sizes = np.array([SIZES[name] for name in classes])
    bev_boxes = Boxes3D(
        centers=np.stack([random.uniform(-4, 4, len(classes)), ahead, sizes[:, 2] / 2 - 1.84], -1),
        sizes_lwh=sizes,
        yaws=random.uniform(-np.pi, np.pi, len(classes)),
        velocities=np.zeros((len(classes), 2)),
        classes=classes,
    )
    return bev_boxes.transformed(RIG.ego_from_bev)


def _map() -> BevMap:
    """A straight road, 8 m wide, in driving direction."""
    cells = np.zeros((64, 64), dtype=np.uint8)
    cells[:, 24:40] = 1
    return BevMap(cells, (-REACH_M, REACH_M), (-REACH_M, REACH_M))


def batch_of(
    drives: PaintedDrives,
    clips: list[Clip],
    config: ModelConfig = CONFIG,
    augmentation: AugmentationConfig = AugmentationConfig(0, 0),
    seed: int = 0,
    *,
    learn_all: bool = False,
    plain: bool = False,
) -> Batch:
    """A batch of these clips, as a training makes it of clips that it draws."""
    settings = ClipConfig(learn="all" if learn_all else "last")
    maker = BatchMaker(drives, config, settings, augmentation, 0, 0, with_gap=False, plain=plain, in_bytes=False)
    random = np.random.default_rng(seed)
    return joined([maker.load(clip, random) for clip in clips])
