"""A BEVFormer with some thousand weights, and random inputs for it."""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from bevcli.geometry.bev_grid import BevGrid
from bevcli.model.bevformer import BEVFormer
from bevcli.model.config import ImageConfig, ModelConfig
from bevcli.model.decoder import DecoderConfig
from bevcli.model.efficientnet_lite import EfficientNetLiteConfig
from bevcli.model.encoder import EncoderConfig
from bevcli.model.fpn import FPNConfig
from bevcli.model.hybrid_queries import HybridQueriesConfig
from bevcli.model.image_tokens import ImageTokensConfig
from bevcli.model.nanodet import NanoDetConfig
from bevcli.model.resnet import ResNetConfig
from bevcli.model.step import ModelInputs, ModelOutputs
from bevcli.workshop.engines.export_form import pixels_of, recurrent_feed
from bevcli.workshop.engines.exported import ExportedModel

CAMERAS = ("FRONT", "BACK")
HEIGHT, WIDTH = 64, 96


def small_config(**changes: object) -> ModelConfig:
    """Two cameras, two feature levels, 6 x 8 cells over 24 x 32 m."""
    settings: dict[str, object] = {
        "name": "small-for-tests",
        "classes": ("car", "pedestrian", "barrier"),
        "cameras": CAMERAS,
        "image": ImageConfig((WIDTH, HEIGHT), (120, 120, 120), (60, 60, 60), "rgb"),
        "bev_grid": BevGrid(6, 8, x_range_m=(-16, 16), y_range_m=(-12, 12), z_range_m=(-3, 2), pillar_points=2),
        "channels": 32,
        "backbone": ResNetConfig((1, 1, 1, 1), "pytorch", output_stages=(3, 4), deformable_stages=(4,), width=8),
        "neck": FPNConfig(levels=3),
        "image_tokens": ImageTokensConfig(level_embeddings=3),
        "encoder": EncoderConfig(2, attention_heads=4, temporal_points=2, spatial_points=4, feed_forward_width=48),
        "decoder": DecoderConfig(2, attention_heads=4, points=2, queries=12, feed_forward_width=48, max_boxes=10),
    }
    return ModelConfig(**{**settings, **changes})  # type: ignore[arg-type]


def small_model(seed: int = 0, **changes: object) -> BEVFormer:
    """In evaluation mode. Random numbers are added to all weights, so that none is zero and hides an error."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        model = BEVFormer(small_config(**changes)).eval()
        with torch.no_grad():
            for parameter in model.parameters():
                parameter.add_(0.1 * torch.randn(parameter.shape))
    return model


FAST_BACKBONE = ResNetConfig((1, 1, 1, 1), "pytorch", output_stages=(3, 4), deformable_stages=(), width=8)


def model_for_engines(
    backbone: ResNetConfig | EfficientNetLiteConfig | NanoDetConfig = FAST_BACKBONE,
    hybrid_queries: int = 0,
    **changes: object,
) -> BEVFormer:
    """A small model without deformable convolutions, which OpenVINO lacks; duplicates of its boxes merge and fade."""
    return small_model(
        encoder=replace(small_config().encoder, layers=1),
        decoder=replace(small_config().decoder, layers=1, merge_duplicates=0.6, fade_duplicates=0.7),
        backbone=backbone,
        neck=FPNConfig(levels=2),
        image_tokens=ImageTokensConfig(level_embeddings=2, calibration_embedding=True),
        hybrid_queries=HybridQueriesConfig(hybrid_queries, level="image_detector" in changes),
        **changes,
    )


def small_inputs(seed: int = 0, batch: int = 1) -> ModelInputs:
    """Random images, one camera that looks along +y and one along -y, and a vehicle that moved slightly."""
    random = torch.Generator().manual_seed(seed)
    projections = torch.from_numpy(np.stack([_image_from_bev(1.0), _image_from_bev(-1.0)])).float()
    return ModelInputs(
        images=torch.randn(batch, 2, 3, HEIGHT, WIDTH, generator=random),
        image_from_bev=projections.expand(batch, -1, -1, -1) + 0.1 * torch.randn(batch, 1, 1, 1, generator=random),
        camera_index=torch.arange(2),
        image_sizes=torch.tensor([WIDTH, HEIGHT], dtype=torch.float32).expand(batch, 2, 2),
        has_image=torch.ones(batch, 2, dtype=torch.bool),
        can_bus=torch.randn(batch, 18, generator=random),
        shift=0.1 * torch.randn(batch, 2, generator=random),
        rotation_deg=20 * torch.randn(batch, generator=random),
    )


def step_of_file(exported: ExportedModel, inputs: ModelInputs, history: Tensor | None = None) -> ModelOutputs:
    """One step of an exported BEVFormer."""
    config = exported.config
    feed = recurrent_feed(replace(inputs, images=pixels_of(inputs.images, config.image)), history, config)
    outputs: ModelOutputs = exported(exported.outputs_by_name(feed))
    return outputs


def check_file(exported: ExportedModel, model: BEVFormer) -> None:
    """A file equals its model, with and without history."""
    history = torch.randn(1, 48, 32, generator=torch.Generator().manual_seed(1))
    for previous in (None, history):
        with torch.inference_mode():
            expected, found = model(small_inputs(), previous), step_of_file(exported, small_inputs(), previous)
        torch.testing.assert_close(found.bev, expected.bev, rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(found.class_logits[-1], expected.class_logits[-1], rtol=1e-4, atol=1e-3)
        torch.testing.assert_close(found.box_codes[-1], expected.box_codes[-1], rtol=1e-4, atol=1e-3)


def _image_from_bev(direction: float) -> np.ndarray:
    """A camera at the origin of the bev frame that looks along +y (1) or -y (-1), field of view 90 degrees."""
    image_from_camera = np.array([[WIDTH / 2, 0, WIDTH / 2, 0], [0, WIDTH / 2, HEIGHT / 2, 0], [0, 0, 1, 0]])
    camera_from_bev = np.array([[direction, 0, 0, 0], [0, 0, -1, 0], [0, direction, 0, 0], [0, 0, 0, 1.0]])
    return np.concatenate([image_from_camera @ camera_from_bev, [[0, 0, 0, 1]]])
