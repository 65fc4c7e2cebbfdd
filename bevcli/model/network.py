"""The base of the published models: the parts that they share, in the order of the paper's figure 2."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from bevcli.errors import BevcliError
from bevcli.model.bev_queries import BevQueries
from bevcli.model.config import ModelConfig
from bevcli.model.decoder import Decoder, DetectionHead
from bevcli.model.deformable_attention import FeatureMaps
from bevcli.model.encoder import Encoder
from bevcli.model.fpn import FPN
from bevcli.model.horizon import Horizon
from bevcli.model.hybrid_queries import HybridQueries
from bevcli.model.image_boxes import ImageBoxes
from bevcli.model.image_tokens import CalibrationEmbedding, ImageTokens
from bevcli.model.pillar_projection import PillarHits, Pillars
from bevcli.model.road_slopes import RoadSlopes, levelled, upright_images
from bevcli.model.segmentation import SegmentationHead
from bevcli.model.step import Clip, ModelOutputs
from bevcli.model.temporal_model import TemporalModel, build_model
from bevcli.model.upload import on_device, upload_together, without_autocast

STAGES = {name: name for name in ("backbone", "neck", "encoder", "decoder", "segmentation_head")}
CAMERA_EMBEDDING = "image_tokens.camera_embedding"  # the key of the tensor that has a row for each camera


class Network(TemporalModel):
    """The parts that the published models share, in the order of the paper's figure 2.

    A subclass says how a frame goes through them, and which memory it leaves.
    """

    stages: Mapping[str, str] = STAGES

    def __init__(self, config: ModelConfig) -> None:
        super().__init__(config)
        grid, channels, levels = config.bev_grid, config.channels, config.encoder_levels
        bev_shape = (grid.rows, grid.columns)
        self.backbone = config.backbone.build()
        self.image_detector = config.image_detector.build() if config.image_detector else None
        self.horizon = Horizon() if config.horizon else None
        self.neck = FPN(config.backbone.output_channels(), channels, config.neck)
        self.image_tokens = ImageTokens(len(config.cameras), channels, config.image_tokens)
        hybrid, height_m = config.hybrid_queries, config.bev_frame.height_m
        embeds_rays = config.image_tokens.calibration_embedding
        self.calibration_embedding = CalibrationEmbedding(channels, height_m) if embeds_rays else None
        self.bev_queries = BevQueries(grid, channels, config.ego_motion.can_bus)
        self.pillars = Pillars(grid)
        self.encoder = Encoder(config.encoder, channels, levels, grid, config.ego_motion)
        self.decoder = Decoder(config.decoder, channels, bev_shape)
        self.detection_head = DetectionHead(config.decoder.layers, channels, len(config.classes), grid)
        self.hybrid_queries = HybridQueries(hybrid, config.classes, grid, height_m) if hybrid.count else None
        segments = "segmentation" in config.heads
        self.segmentation_head = SegmentationHead(config.segmentation, channels, bev_shape) if segments else None

    def image_features(self, images: Tensor, camera_index: Tensor) -> FeatureMaps:
        """The tokens of B·N images, for the encoder.

        images: (B, N, 3, H, W), normalised, padded. camera_index: (N,) or (B, N), the camera embedding of each image.
        """
        return self.tokens_of(self.image_maps(images), camera_index)

    def image_maps(
        self, images: Tensor, image_from_upright: Tensor | None = None, sizes: Tensor | None = None
    ) -> list[Tensor]:
        """The maps of the backbone for B·N images. images: (B, N, 3, H, W), normalised, padded.

        image_from_upright, sizes: turn the images first, see `upright_images`.
        """
        smaller, whole = self.config.backbone_scale
        size = [extent * smaller // whole for extent in images.shape[-2:]]
        if image_from_upright is not None and sizes is not None:
            images = upright_images(images, image_from_upright, sizes, size)
            images = images.contiguous(memory_format=torch.channels_last)
        elif smaller < whole:
            images = F.interpolate(images.flatten(0, 1), size, mode="bicubic", align_corners=False)
        else:
            images = images.flatten(0, 1)
        maps: list[Tensor] = self.backbone(images)
        return maps

    @on_device
    def find_image_boxes(self, images: Tensor, has_image: Tensor, image_sizes: Tensor) -> ImageBoxes:
        """The boxes that the detector beside the backbone finds. Arguments: see `ModelInputs`."""
        images, has_image, image_sizes = upload_together((images, has_image, image_sizes), self.device)
        assert self.image_detector is not None
        return self.image_detector.image_boxes(self.image_detector(images.flatten(0, 1)), has_image, image_sizes)

    @on_device
    def find_slopes(self, images: Tensor, image_from_bev: Tensor) -> RoadSlopes:
        """The slopes of the road that the horizon tells. Arguments: see `ModelInputs`."""
        images, image_from_bev = upload_together((images, image_from_bev), self.device)
        assert self.horizon is not None
        with without_autocast(self.device):  # half precision is too coarse for the ring
            slopes: RoadSlopes = self.horizon(images, image_from_bev)
        return slopes

    def look(
        self,
        images: Tensor,
        has_image: Tensor,
        image_from_bev: Tensor,
        image_sizes: Tensor,
        expected: RoadSlopes | None = None,
    ) -> tuple[ImageBoxes | None, Tensor, RoadSlopes | None, RoadSlopes | None]:
        """The boxes of the detector beside the backbone, None without one; the level rig, image_from_bev itself where
        the model does not level it; the slopes of the road, None where boxes do not tell them; and those without boxes.

        expected: slopes, see `expected_slopes`. Others: see `ModelInputs`.
        """
        seen = None if self.horizon is None else self.find_slopes(images, image_from_bev)
        if seen is not None and not self.config.levels:
            image_from_bev = levelled(image_from_bev, seen.to(image_from_bev.device), self.config.bev_frame.height_m)
        if self.image_detector is None:
            return None, image_from_bev, None, expected
        boxes = self.find_image_boxes(images, has_image, image_sizes)
        if self.hybrid_queries is None or not self.config.levels:
            return boxes, image_from_bev, None, expected
        return boxes, *self.hybrid_queries.levelled(boxes, (image_from_bev, image_sizes, expected), seen)

    def tokens_of(self, maps: list[Tensor], camera_index: Tensor) -> FeatureMaps:
        """As `image_features`, of the maps of the backbone."""
        return self.image_tokens(self.neck(maps)[: self.config.encoder_levels], camera_index)

    def detect(self, bev: Tensor) -> ModelOutputs:
        """The outputs of the decoder and the heads for a BEV map (B, Y·X, C)."""
        # In float32: half precision is too coarse for the refinement of boxes.
        with without_autocast(bev.device):
            class_logits, box_codes, _ = self.decoder(bev.float(), self.detection_head)
            segmentation = None
            if self.segmentation_head is not None:
                segmentation = self.segmentation_head(bev.float(), self.bev_queries.position())
        return ModelOutputs(bev, class_logits, box_codes, segmentation)

    def detect_with_images(
        self,
        bev: Tensor,
        boxes: ImageBoxes | None,
        image_from_bev: Tensor,
        image_from_level: Tensor,
        image_sizes: Tensor,
        expected: RoadSlopes | None = None,
    ) -> ModelOutputs:
        """As `detect`, with the boxes in the images, and the queries that start from them, where the model has these.

        image_from_bev, image_sizes: see `ModelInputs`. image_from_level: as image_from_bev, of the rig that made `bev`.
        expected: see `look`.
        """
        outputs = self.detect(bev)
        if self.hybrid_queries is not None and boxes is not None:
            with without_autocast(bev.device):
                hybrid_logits, hybrid_codes = self.hybrid_queries(boxes, image_from_bev, image_sizes, expected)
                learned = outputs.class_logits, outputs.box_codes
                cameras = image_from_level, image_sizes
                logits, hybrid_logits = self.hybrid_queries.weighed(learned, hybrid_logits, boxes, cameras)
                outputs = replace(outputs, class_logits=logits).with_queries(hybrid_logits, hybrid_codes)
        return replace(outputs, image_boxes=boxes)

    def history_of_clip(self, clip: Clip, frame: int, memory: Any) -> Any:
        """The memory after a frame of training clips that is history only; None before the first frame. No gradient."""
        raise NotImplementedError

    def outputs_of_clip(self, clip: Clip, frame: int, memory: Any) -> tuple[ModelOutputs, Any]:
        """The outputs for a frame of training clips, and the memory after it, which has no gradient."""
        raise NotImplementedError

    def run_shapes(self, images: Tensor, camera_index: Tensor, hits: PillarHits) -> None:
        """Run a frame with history, so that `bevcli bench` counts its operations, on the device "meta".

        images: (1, N, 3, H, W). camera_index: (N,). hits: as in a real frame.
        """
        raise NotImplementedError

    def part_names(self) -> Iterator[tuple[str, ...]]:
        """See `TemporalModel`."""
        yield from self.bev_part_names()
        layers = self.config.decoder.layers
        yield "object queries (position, content)", "decoder.query_embedding"
        yield "object queries: reference points", "decoder.reference_points"
        attentions = {"self_attention": "self-attention", "cross_attention": "cross-attention to BEV"}
        yield from _layer_names("decoder", layers, attentions)
        yield f"detection head: {layers} class branches", "detection_head.class_branches"
        yield f"detection head: {layers} box branches", "detection_head.box_branches"
        yield "hybrid queries: lift of boxes in images", "hybrid_queries.lift"
        yield "segmentation: stuff queries", "segmentation_head.stuff_queries"
        yield "segmentation: location decoder", "segmentation_head.location_decoder"
        for layer in range(self.config.segmentation.mask_layers):
            yield f"segmentation: mask decoder layer {layer}", f"segmentation_head.mask_layers.{layer}"

    def bev_part_names(self) -> Iterator[tuple[str, ...]]:
        """The parts up to the BEV map, as `part_names`."""
        yield "backbone: stem", *(f"backbone.{name}" for name in self.backbone.stem_parts)
        for stage, name in enumerate(self.config.backbone.stage_names()):
            yield f"backbone: stage {stage + 1}, {name}", f"backbone.stages.{stage}"
        yield "detector of boxes in the images", "image_detector"
        yield "horizon: slopes of the road", "horizon"
        yield "neck (FPN)", "neck"
        yield "level embeddings", "image_tokens.level_embedding"
        yield "camera embeddings", "image_tokens.camera_embedding"
        yield "calibration embedding", "calibration_embedding"
        yield "BEV queries", "bev_queries.embedding"
        yield "position embedding, rows", "bev_queries.row_embedding"
        yield "position embedding, columns", "bev_queries.column_embedding"
        yield "can-bus MLP", "bev_queries.can_bus_embedding"
        attentions = {
            "temporal_self_attention": "temporal self-attention",
            "spatial_cross_attention": "spatial cross-attention",
        }
        yield from _layer_names("encoder", self.config.encoder.layers, attentions)


def _layer_names(part: str, layers: int, attentions: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """The parts of each layer of encoder or decoder. attentions: module -> name."""
    for layer in range(layers):
        for module, name in {**attentions, "feed_forward": "feed-forward network", "norms": "norms"}.items():
            yield f"{part} layer {layer}: {name}", f"{part}.layers.{layer}.{module}"


def build_network(config: ModelConfig) -> Network:
    """The network of a configuration, with random weights. Raises BevcliError for a model that is no `Network`."""
    model = build_model(config)
    if not isinstance(model, Network):
        raise BevcliError(f"{config.name}: a {config.architecture} can run only; it lacks the parts of a BEVFormer")
    return model
