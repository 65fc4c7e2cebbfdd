"""BEVFormer (Li et al. 2022): camera images and ego-motion in, a BEV map and objects out."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from bevcli.geometry.transforms import Pose
from bevcli.model.config import ModelConfig
from bevcli.model.ego_motion import map_rotation, turned_history
from bevcli.model.image_boxes import ImageBoxes
from bevcli.model.network import Network
from bevcli.model.pillar_projection import PillarHits
from bevcli.model.road_slopes import FollowedPoints, RoadMemory, RoadSlopes, expected_slopes, upright_cameras
from bevcli.model.step import Clip, ModelInputs, ModelOutputs, PreparedFrame, model_inputs
from bevcli.model.upload import on_device, upload, upload_together

sys.modules[f"{__name__}.bevformer"] = sys.modules[__name__]  # its name in releases before 0.2


@dataclass(frozen=True)
class BevHistory:
    """The last BEV map, which the next frame attends to."""

    bev: Tensor  # (1, Y·X, C), the BEV map of the last frame
    pose: Pose  # world_from_ego of that frame
    road: RoadMemory | None = None  # for a model that levels the rig of each frame


@dataclass(frozen=True)
class EncoderInputs:
    """All that the device part of a step reads, on the device or, small tensors, on the CPU."""

    images: Tensor  # see `ModelInputs`, as for image_from_bev, camera_index, has_image, image_sizes, can_bus and shift
    image_from_bev: Tensor
    # (B, N, 4, 4), as image_from_bev, of the rig as the boxes in the images level it; hits and rays are of this rig
    image_from_level: Tensor
    camera_index: Tensor
    has_image: Tensor
    image_sizes: Tensor
    can_bus: Tensor
    shift: Tensor
    hits: PillarHits  # the cells that each camera sees
    # scale and shift of the image features, of the calibration embedding; None without one
    rays: tuple[Tensor, Tensor] | None
    history: Tensor | None  # (B, Y·X, C), the BEV map of the previous frame; None without history
    rotation: Tensor | None  # (B, 2, 3), of the history, see `map_rotation`; None without history
    image_boxes: ImageBoxes | None = None  # of a detector beside the backbone, None without one
    expected_slopes: RoadSlopes | None = None  # before the boxes are looked at, see `Network.look`
    image_from_upright: Tensor | None = None  # (B, N, 3, 3), see `upright_images`; None: the images stay as they are


class BEVFormer(Network):
    """The whole model: a recurrence, in which the BEV map of a frame is the history of the next."""

    memory_type: ClassVar[type] = BevHistory

    def step(
        self, prepared: PreparedFrame, memory: BevHistory | None, upcoming: Sequence[PreparedFrame] = ()
    ) -> tuple[ModelOutputs, BevHistory]:
        inputs = model_inputs(prepared, None if memory is None else memory.pose, self.config)
        expected = self.slopes_before(prepared, memory)
        inputs = replace(inputs, images=upload(inputs.images, self.device), expected_slopes=expected)
        outputs = self(inputs, None if memory is None else memory.bev)
        return outputs, self.history_after(prepared, outputs.bev, outputs.road_slopes)

    @staticmethod
    def slopes_before(prepared: PreparedFrame, memory: BevHistory | None) -> RoadSlopes | None:
        """See `expected_slopes`; None for a model that does not ask for them. memory: of the frame before."""
        if prepared.grey is None:
            return None
        if memory is None or memory.road is None:
            return RoadSlopes.unknown()
        points, road, pose = prepared.points, memory.road, memory.pose
        if points is None or points.view is not road.view or points.pose is not pose:  # not those of this memory
            points = FollowedPoints.follow(road.view, pose, prepared.grey, prepared.frame.world_from_ego)
        return expected_slopes(road, points)

    @staticmethod
    def history_after(prepared: PreparedFrame, bev: Tensor, slopes: RoadSlopes | None) -> BevHistory:
        """The memory after a frame. bev, slopes: of the model's outputs."""
        road = None if prepared.grey is None or slopes is None else RoadMemory(prepared.grey, slopes)
        return BevHistory(bev, prepared.frame.world_from_ego, road)

    def forward(self, inputs: ModelInputs, history: Tensor | None = None) -> ModelOutputs:
        """One step. history: (B, Y·X, C), the BEV map of the previous frame, or None for a scene's first frame."""
        encoder_inputs, slopes = self.geometry(inputs, history)
        outputs: ModelOutputs = self.compute(encoder_inputs)
        return outputs if slopes is None else replace(outputs, road_slopes=slopes)

    def geometry(self, inputs: ModelInputs, history: Tensor | None) -> tuple[EncoderInputs, RoadSlopes | None]:
        """The host part of a step: what it needs of calibration and poses, as tensors; and the slopes of the road.

        Arguments as for `forward`.
        """
        size = inputs.image_size
        rays = rotation = image_from_upright = None
        cameras = inputs.images, inputs.has_image, inputs.image_from_bev, inputs.image_sizes
        boxes, image_from_level, slopes, expected = self.look(*cameras, inputs.expected_slopes)
        upright_from_level = image_from_level
        if slopes is not None:
            upright_from_level, image_from_upright = upright_cameras(inputs.image_from_bev, image_from_level)
        if self.calibration_embedding is not None:
            rays = self.calibration_embedding(upright_from_level, self.config.level_shapes_of(size), size)
        if history is not None:
            center = self.config.ego_motion.history_rotation_center
            rotation = map_rotation(inputs.rotation_deg, self.config.bev_grid, center)
        encoder_inputs = EncoderInputs(
            images=inputs.images,
            image_from_bev=inputs.image_from_bev,
            image_from_level=image_from_level,
            camera_index=inputs.camera_index,
            has_image=inputs.has_image,
            image_sizes=inputs.image_sizes,
            can_bus=inputs.can_bus,
            shift=inputs.shift,
            hits=self.pillars(upright_from_level, size, inputs.has_image),
            rays=rays,
            history=history,
            rotation=rotation,
            image_boxes=boxes,
            expected_slopes=expected,
            image_from_upright=image_from_upright,
        )
        return encoder_inputs, slopes

    @on_device
    def compute(self, inputs: EncoderInputs, heads: bool = True) -> Any:
        """The device part of a step (the paper's figure 2): its outputs, or without `heads` the BEV map (B, Y·X, C)."""
        inputs = upload_together(inputs, self.device)
        maps = self.image_maps(inputs.images, inputs.image_from_upright, inputs.image_sizes)
        image_features = self.tokens_of(maps, inputs.camera_index)
        if inputs.rays is not None:
            image_features = image_features.scaled(*inputs.rays)
        history = inputs.history
        if history is not None:
            assert inputs.rotation is not None
            history = turned_history(history, inputs.rotation, self.config.bev_grid)
        bev: Tensor = self.encoder(
            bev_query=self.bev_queries(inputs.can_bus),
            position=self.bev_queries.position(),
            image_features=image_features,
            hits=inputs.hits,
            history=history,
            shift=inputs.shift,
        )
        if not heads:
            return bev
        boxes = inputs.image_boxes or self.backbone.image_boxes(maps, inputs.has_image, inputs.image_sizes)
        cameras = inputs.image_from_bev, inputs.image_from_level, inputs.image_sizes
        return self.detect_with_images(bev, boxes, *cameras, inputs.expected_slopes)

    def with_pose(self, memory: BevHistory, pose: Pose) -> BevHistory:
        """See `TemporalModel`."""
        return replace(memory, pose=pose)

    def fix_constant_parts(self) -> None:
        """See `TemporalModel`."""
        self.decoder.fix_first_attention()

    def history_of_clip(self, clip: Clip, frame: int, memory: Tensor | None) -> Tensor:
        """See `Network`; the memory of clips is their BEV map (B, Y·X, C)."""
        bev: Tensor = self.compute(self.geometry(clip.inputs[frame], memory)[0], False)
        return bev

    def outputs_of_clip(self, clip: Clip, frame: int, memory: Tensor | None) -> tuple[ModelOutputs, Tensor]:
        """See `Network`."""
        outputs = self(clip.inputs[frame], memory)
        return outputs, outputs.bev.detach()

    def run_shapes(self, images: Tensor, camera_index: Tensor, hits: PillarHits) -> None:
        """See `Network`."""
        history = torch.empty(1, *self.bev_queries.embedding.shape)
        can_bus, shift, rotation = torch.empty(1, 18), torch.empty(1, 2), torch.empty(1, 2, 3)
        has_image = torch.ones(images.shape[:2], dtype=torch.bool, device=images.device)
        projections, sizes = torch.eye(4).expand(*images.shape[:2], 4, 4), torch.ones(*images.shape[:2], 2)
        cameras = projections, projections, camera_index, has_image, sizes
        boxes = None if self.image_detector is None else self.find_image_boxes(images, has_image, sizes)
        if self.horizon is not None:
            self.find_slopes(images, projections)
        self.compute(EncoderInputs(images, *cameras, can_bus, shift, hits, None, history, rotation, boxes))

    @classmethod
    def export_form(cls, config: ModelConfig, cameras: int) -> Any:
        """See `TemporalModel`."""
        from bevcli.workshop.engines.export_form import RecurrentForm

        return RecurrentForm(config, cameras)
