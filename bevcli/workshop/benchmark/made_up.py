"""Made-up inputs for timing: a drive with six cameras, and a model with random weights."""

import math
from functools import partial

import cv2
import numpy as np
import torch
from torch import nn

from bevcli.config import load_config
from bevcli.frame import CameraImage, Drive, Frame, FrameStamp
from bevcli.geometry.cameras import NUSCENES_YAWS_DEG, Camera, CameraRig, default_ego_from_bev
from bevcli.geometry.ego_motion import GRAVITY, Kinematics
from bevcli.geometry.transforms import Pose, rigid, rotation_about_z
from bevcli.inference.load import Model, choose_engine, load_model
from bevcli.inference.options import EXPORTED_SUFFIX, ModelOptions
from bevcli.model.config import ModelConfig
from bevcli.model.network import Network, build_network
from bevcli.parsing.images import encode_image
from bevcli.sequences.images import ImageReader, MessageSource
from bevcli.workshop.engines.engine import CALIBRATION_FRAMES as CALIBRATION_FRAMES

WIDTH, HEIGHT = 1600, 900
FOCAL_LENGTH = 1266.0  # pixels, of all nuScenes cameras but the one at the back
BACK_FOCAL_LENGTH = 809.0
STEP_S = 0.5
SPEED = 8.0  # m/s
ENCODED_IMAGES = 12  # JPEG files in memory, which the frames and cameras use in turn

SEED = 0
RESIDUAL_GAIN = 0.25  # of the backbone's blocks, whose initial gain is zero
USUAL_DEVIATION = 57.0  # standard deviation of images, grey levels; other values of `image.std` scale the first layer


class MadeUpDrive(Drive):
    """A drive of any length with moving vehicle and JPEG images.

    The cameras' directions and lenses are those of nuScenes, so that the cameras see as many BEV cells.
    """

    name = "made-up"
    has_ego_motion = True

    def __init__(self, frames: int) -> None:
        self.rig = CameraRig(tuple(map(_camera, NUSCENES_YAWS_DEG)), default_ego_from_bev())
        self.stamps = tuple(FrameStamp(i, "", 10**18 + int(i * STEP_S * 1e9)) for i in range(frames))
        self._files = [_jpeg(seed) for seed in range(ENCODED_IMAGES)]
        self._reader = ImageReader(strict=True)

    def load(self, index: int) -> Frame:
        """The frame at an index; every call decodes its six images, in threads as those of other drives."""
        stamp, pose, first = self.stamps[index], self.pose(index), index * len(self.rig.names)
        decoders = {name: partial(self._image, first + i, stamp) for i, name in enumerate(self.rig.names)}
        sources = {name: MessageSource(name, stamp.timestamp_ns, decode) for name, decode in decoders.items()}
        return Frame(
            stamp=stamp,
            rig=self.rig,
            images=self._reader.read(sources, self.rig, dropped={})[0],
            world_from_ego=pose,
            world_from_ego_at=dict.fromkeys(self.rig.names, pose),
            kinematics=Kinematics(np.array([0, 0, GRAVITY]), np.array([0, 0, 0.05]), np.array([SPEED, 0, 0])),
        )

    def pose(self, index: int) -> Pose:
        """world_from_ego of the frame at an index."""
        seconds = index * STEP_S
        yaw = 0.05 * seconds
        return Pose(np.array([SPEED * seconds, 0.2 * seconds, 0]), np.array([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]))

    def _image(self, number: int, stamp: FrameStamp) -> CameraImage:
        encoded = self._files[number % ENCODED_IMAGES]
        pixels = cv2.imdecode(np.frombuffer(encoded, dtype=np.uint8), cv2.IMREAD_COLOR)
        assert pixels is not None
        return CameraImage(stamp.timestamp_ns, pixels.astype(np.uint8, copy=False), encoded, "image/jpeg")


def made_up_model(config: ModelConfig) -> Network:
    """A model with random weights, the same at every call.

    Weights that are initialised to zero get small random numbers, so that every part affects the result and an error
    in any part shows.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(SEED)
        model = build_network(config).eval()
        with torch.no_grad():
            for name, parameter in model.named_parameters():
                if name.endswith("bn3.weight"):
                    nn.init.constant_(parameter, RESIDUAL_GAIN)
                elif parameter.ndim > 1 and not parameter.any():
                    nn.init.normal_(parameter, std=0.5 / math.sqrt(parameter[0].numel()))
            first = next(module for module in model.backbone.modules() if isinstance(module, nn.Conv2d))
            first.weight *= sum(config.image.std) / 3 / USUAL_DEVIATION
    return model


def _camera(name: str) -> Camera:
    focal_length = BACK_FOCAL_LENGTH if name == "CAM_BACK" else FOCAL_LENGTH
    intrinsics = np.array([[focal_length, 0, WIDTH / 2], [0, focal_length, 0.55 * HEIGHT], [0, 0, 1]])
    looking_forward = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    turned = rotation_about_z(np.radians(NUSCENES_YAWS_DEG[name]))
    position = turned @ (0.8, 0, 0) + (0.9, 0, 1.5)
    return Camera(name, WIDTH, HEIGHT, intrinsics, rigid(position, turned @ looking_forward))


def _jpeg(seed: int) -> bytes:
    """Shapes of all sizes and some noise, which take about as many bytes as an image of a street."""
    random = np.random.default_rng(seed)
    layers = [random.normal(0, 60 / (i + 1), (9 * 2**i, 16 * 2**i, 3)).astype(np.float32) for i in range(5)]
    image = 110 + sum(cv2.resize(layer, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC) for layer in layers)
    return encode_image(np.clip(image, 0, 255).astype(np.uint8), quality=95)


def model_to_time(name: str, options: ModelOptions) -> Model:
    """The exported file of a name, or a model with made-up weights for the engine that is asked for."""
    if name.endswith(EXPORTED_SUFFIX):
        return load_model(name, options=options)
    config = load_config(name)
    engine, device, precision = choose_engine(options, config)
    return Model(made_up_model(config), device, precision, engine=engine)
