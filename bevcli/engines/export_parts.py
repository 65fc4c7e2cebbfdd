"""The step of the model in the form that is exported to ONNX: the same numbers, standard operators only.

The plain model knows nothing of this. `ExportedStep` is a copy of it whose parts that ONNX cannot express are replaced.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

from bevcli.model.bevformer import BEVFormer, BEVFormerConfig
from bevcli.model.deformable_attention import FeatureMaps, sample_maps, sampling_locations
from bevcli.model.deformable_convolution import ModulatedDeformableConvolution, split_offsets_and_mask
from bevcli.model.encoder import EncoderLayer, SpatialCrossAttention
from bevcli.model.pillar_projection import PillarProjection

DeformableConvolution = Literal["operator", "gridsample"]


class ExportedStep(nn.Module):
    """One step of a BEVFormer for batches of one: `BEVFormer.forward` with flat inputs and outputs.

    The images enter before normalisation, and the history enters as a tensor that is ignored where `use_previous` is
    false, because a graph has no optional inputs.
    """

    image_mean: Tensor
    image_std: Tensor

    def __init__(self, model: BEVFormer, deformable_convolution: DeformableConvolution, *, decode: bool) -> None:
        """A copy of the model, with its parts replaced; the model itself stays unchanged."""
        super().__init__()
        self.network = copy.deepcopy(model).cpu().float().eval().requires_grad_(False)
        self.config, self.decode = model.config, decode
        replace_parts(self.network, deformable_convolution)
        image = self.config.image
        self.register_buffer("image_mean", torch.tensor(image.mean)[:, None, None])
        self.register_buffer("image_std", torch.tensor(image.std)[:, None, None])

    def forward(
        self,
        images: Tensor,
        image_from_bev: Tensor,
        camera_index: Tensor,
        has_image: Tensor,
        can_bus: Tensor,
        shift: Tensor,
        rotation: Tensor,
        previous_bev: Tensor,
        use_previous: Tensor,
    ) -> tuple[Tensor, ...]:
        """One step; `bevcli.engines.interface` documents every input and output."""
        network = self.network
        feature_maps = network.neck(network.backbone(self._normalized(images)))
        bev_query = network.bev_queries(can_bus)
        position = network.bev_queries.position()
        history = network.align_history(previous_bev, rotation)
        centers = network.encoder.cell_centers.expand(1, 2, -1, -1)
        reference_points = torch.where(use_previous, network.encoder.reference_points(shift), centers)
        hits = list_hits(network.pillars.project(image_from_bev, (images.shape[2], images.shape[3]), has_image))
        image_features = network.image_tokens(feature_maps, camera_index)
        if network.calibration_embedding is not None:
            image_size = images.shape[2], images.shape[3]
            image_features = network.calibration_embedding(image_features, image_from_bev, image_size)
        with_history = torch.stack([history, bev_query], dim=1)
        bev = bev_query
        for layer in network.encoder.layers:
            assert isinstance(layer, EncoderLayer)
            bev_maps = torch.where(use_previous, with_history, torch.stack([bev, bev], dim=1))
            bev = layer(bev, position, bev_maps, reference_points, image_features, hits)
        class_logits, box_codes, _ = network.decoder(bev, network.detection_head)
        outputs = [bev, class_logits[-1], box_codes[-1]]
        if network.segmentation_head is not None:
            segmentation = network.segmentation_head(bev, position)
            outputs += [segmentation.mask_logits[-1], segmentation.class_logits[-1]]
        if self.decode:
            outputs += decode_boxes(class_logits[-1], box_codes[-1], self.config)
        return tuple(outputs)

    def _normalized(self, images: Tensor) -> Tensor:
        """(1, N, H, W, 3) BGR, 0 to 255 -> (N, 3, H, W), as the backbone takes them."""
        planes = images[0].permute(0, 3, 1, 2)
        if self.config.image.color_order == "rgb":
            planes = planes.flip(1)
        return (planes - self.image_mean) / self.image_std


@dataclass(frozen=True)
class CameraHits:
    """The cells that each camera sees, as lists of different lengths.

    Attributes:
        cells: for each camera n, (M_n,) int64, the indices of the cells that it sees.
        reference_points: for each camera n, (M_n, Z, 2) float32, the points of these cells' pillars, 0 to 1 over the
            padded image.
        cameras_per_cell: (Y·X, 1) float32, the number of cameras that see a cell, at least 1.
    """

    cells: tuple[Tensor, ...]
    reference_points: tuple[Tensor, ...]
    cameras_per_cell: Tensor


def list_hits(projection: PillarProjection) -> CameraHits:
    """The hits of one batch element, camera by camera: one NonZero operator a camera."""
    hit = projection.hit[0]  # (N, Y·X)
    cells = tuple(seen.nonzero()[:, 0] for seen in hit.unbind(0))
    points = zip(projection.reference_points[0].unbind(0), cells, strict=True)
    return CameraHits(
        cells=cells,
        reference_points=tuple(camera.index_select(0, seen) for camera, seen in points),
        cameras_per_cell=hit.float().sum(0).clamp(min=1)[:, None],
    )


class ListedSpatialCrossAttention(nn.Module):
    """Takes the place of `SpatialCrossAttention`, for batches of one and hits that are listed camera by camera."""

    def __init__(self, original: SpatialCrossAttention) -> None:
        super().__init__()
        self.points, self.attention = original.points, original.attention

    def forward(self, query: Tensor, image_features: FeatureMaps, hits: CameraHits) -> Tensor:
        """As `SpatialCrossAttention.forward`."""
        offsets, weights = (part[:, :, 0] for part in self.attention.predict(query[0]))
        heads = self.attention.shape[0]
        values = self.attention.value_projection(image_features.tokens).unflatten(-1, (heads, -1))
        summed = torch.zeros_like(query[0])
        for camera, (cells, points) in enumerate(zip(hits.cells, hits.reference_points, strict=True)):
            reference = points.repeat(1, self.points // points.shape[1], 1)[:, None, None]
            level_shapes = image_features.level_shapes
            locations = sampling_locations(reference, offsets.index_select(0, cells), level_shapes)
            weight = weights.index_select(0, cells)
            sampled = sample_maps(values[camera, None], level_shapes, locations[None], weight[None])[0]  # (M_n, C)
            summed = summed.index_add(0, cells, sampled)
        return self.attention.output_projection(summed / hits.cameras_per_cell)[None]


class DeformConvOperator(nn.Module):
    """Takes the place of a `ModulatedDeformableConvolution`: the operator DeformConv of ONNX, opset 19."""

    def __init__(self, original: ModulatedDeformableConvolution) -> None:
        super().__init__()
        self.weight, self.offset_and_mask, self.stride = original.weight, original.offset_and_mask, original.stride

    def forward(self, x: Tensor) -> Tensor:
        """x: (B, C, H, W) -> (B, O, H', W'). Only for export: in PyTorch its result is zero."""
        offsets, mask = split_offsets_and_mask(self.offset_and_mask(x))
        bias = x.new_zeros(len(self.weight))
        return torch.onnx.ops.symbolic(
            "DeformConv",
            [x, self.weight, offsets.flatten(1, 2), bias, mask],
            {"kernel_shape": [3, 3], "pads": [1, 1, 1, 1], "strides": [self.stride, self.stride]},
            dtype=x.dtype,
            shape=(len(x), len(self.weight), *mask.shape[-2:]),
            version=19,
        )


def replace_parts(part: nn.Module, deformable_convolution: DeformableConvolution) -> None:
    """Replaces, in place, the spatial cross-attentions and, for "operator", the deformable convolutions."""
    for name, child in part.named_children():
        if isinstance(child, SpatialCrossAttention):
            setattr(part, name, ListedSpatialCrossAttention(child))
        elif isinstance(child, ModulatedDeformableConvolution) and deformable_convolution == "operator":
            setattr(part, name, DeformConvOperator(child))
        else:
            replace_parts(child, deformable_convolution)


def decode_boxes(class_logits: Tensor, box_codes: Tensor, config: BEVFormerConfig) -> tuple[Tensor, Tensor, Tensor]:
    """`bevcli.model.box_coding.decode` for a batch of one, in the graph.

    Args:
        class_logits: (1, Q, classes).
        box_codes: (1, Q, 10).
        config: of the model.

    Returns:
        Boxes (1, K, 9): centre x, y, z and length, width, height in metres, yaw in radians, velocity x, y in m/s, all
        in the bev frame; scores (1, K), falling; classes (1, K) int64.
    """
    classes = len(config.classes)
    scores = class_logits.sigmoid().flatten(1)  # (1, Q · classes)
    best, index = scores.topk(min(config.decoder.max_boxes, scores.shape[1]))
    code = box_codes[0].index_select(0, index[0] // classes)[None]  # (1, K, 10)
    x, y, log_width, log_length, z, log_height, sin, cos, *velocity = code.unbind(-1)
    # The code's angle a is clockwise from -y: yaw = -a - pi / 2, whose sine is -cos a and whose cosine is -sin a.
    yaw = torch.atan2(-cos, -sin)
    sizes = [log.exp() for log in (log_length, log_width, log_height)]
    return torch.stack([x, y, z, *sizes, yaw, *velocity], dim=-1), best, index % classes
