"""One step of a model in the form that is exported to ONNX: `forward` with flat inputs and outputs.

The plain model knows nothing of this. A step holds a copy of it whose parts are replaced by those of `export_parts`.
"""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn

from bevcli.engines.export_parts import DeformableConvolution, SlottedHits, replace_parts, slot_hits
from bevcli.model.bevformer import BEVFormer, BEVFormerBase, BEVFormerConfig
from bevcli.model.bevformer_v2 import BEVFormerV2
from bevcli.model.deformable_attention import FeatureMaps
from bevcli.model.encoder import EncoderLayer
from bevcli.model.prepared import fold_batch_norms


class ExportedStep(nn.Module):
    """What the steps of all models share, for batches of one. Images enter before normalisation."""

    image_mean: Tensor
    image_std: Tensor

    def __init__(
        self, model: BEVFormerBase, deformable_convolution: DeformableConvolution, slots: int, *, decode: bool
    ) -> None:
        """A copy of the model, with its parts replaced; the model itself stays unchanged. slots: see `slot_hits`."""
        super().__init__()
        self.network = copy.deepcopy(model).cpu().float().eval().requires_grad_(False)
        self.config, self.slots, self.decode = model.config, slots, decode
        fold_batch_norms(self.network, torch.device("meta"))  # for no device: with standard operators
        replace_parts(self.network, deformable_convolution)
        image = self.config.image
        width, height = image.padded_size
        self.image_size = height, width
        self.register_buffer("image_mean", torch.tensor(image.mean)[:, None, None])
        self.register_buffer("image_std", torch.tensor(image.std)[:, None, None])

    def image_features(self, images: Tensor, camera_index: Tensor) -> FeatureMaps:
        """The tokens of images (1, N, H, W, 3) BGR, 0 to 255; camera_index: (N,)."""
        planes = images.permute(0, 1, 4, 2, 3)
        if self.config.image.color_order == "rgb":
            planes = planes.flip(2)
        return self.network.image_features((planes - self.image_mean) / self.image_std, camera_index)

    def hits(self, image_from_bev: Tensor, has_image: Tensor) -> SlottedHits:
        """The cameras that see each cell; arguments as for `Pillars.project`."""
        return slot_hits(self.network.pillars.project(image_from_bev, self.image_size, has_image), self.slots)

    def outputs(self, bev: Tensor, most_cameras: Tensor) -> tuple[Tensor, ...]:
        """The outputs that all files have, in their order. bev: (1, Y·X, C). most_cameras: (1,), see `SlottedHits`."""
        network = self.network
        class_logits, box_codes, _ = network.decoder(bev, network.detection_head)
        outputs = [bev, class_logits[-1], box_codes[-1], most_cameras]
        if network.segmentation_head is not None:
            segmentation = network.segmentation_head(bev, network.bev_queries.position())
            outputs += [segmentation.mask_logits[-1], segmentation.class_logits[-1]]
        if self.decode:
            outputs += decode_boxes(class_logits[-1], box_codes[-1], self.config)
        return tuple(outputs)


class RecurrentStep(ExportedStep):
    """One step of a BEVFormer: `BEVFormer.forward`.

    The history enters as a tensor that is ignored where `use_previous` is false, because a graph has no optional
    inputs.
    """

    network: BEVFormer

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
        image_features = self.image_features(images, camera_index)
        if network.calibration_embedding is not None:
            image_features = network.calibration_embedding(image_features, image_from_bev, self.image_size)
        bev_query = network.bev_queries(can_bus)
        position = network.bev_queries.position()
        history = network.align_history(previous_bev, rotation)
        centers = network.encoder.cell_centers.expand(1, 2, -1, -1)
        reference_points = torch.where(use_previous, network.encoder.reference_points(shift), centers)
        hits = self.hits(image_from_bev, has_image)
        with_history = torch.stack([history, bev_query], dim=1)
        bev = bev_query
        for layer in network.encoder.layers:
            assert isinstance(layer, EncoderLayer)
            bev_maps = torch.where(use_previous, with_history, torch.stack([bev, bev], dim=1))
            bev = layer(bev, position, bev_maps, reference_points, image_features, hits)
        return self.outputs(bev, hits.most_cameras)


class WindowStep(ExportedStep):
    """One step of a BEVFormerV2 whose window ends with the current frame: `BEVFormerV2.forward`.

    The image features of the earlier frames enter, and those of the current frame come out. All frames are encoded,
    also those that do not exist, because a graph has no optional parts; a frame without any image then takes the map
    of the next one, as in `fill_window`.
    """

    network: BEVFormerV2

    def forward(
        self,
        images: Tensor,
        image_from_bev: Tensor,
        camera_index: Tensor,
        has_image: Tensor,
        previous_features: Tensor | None = None,
    ) -> tuple[Tensor, ...]:
        """One step; `bevcli.engines.interface` documents every input and output."""
        network = self.network
        image_features = self.image_features(images, camera_index)
        tokens = [*([] if previous_features is None else previous_features), image_features.tokens]
        hits = [self.hits(image_from_bev[:, place], has_image[:, place]) for place in range(len(tokens))]
        maps = [
            network.encoder(
                bev_query=network.bev_queries.embedding[None],
                position=network.bev_queries.position(),
                image_features=FeatureMaps(frame_tokens, image_features.level_shapes),
                hits=frame_hits,
            )
            for frame_tokens, frame_hits in zip(tokens, hits, strict=True)
        ]
        for place in reversed(range(len(maps) - 1)):
            maps[place] = torch.where(has_image[:, place].any(), maps[place], maps[place + 1])
        bev = maps[0] if network.fusion is None else network.fusion(maps)
        most_cameras = torch.cat([frame_hits.most_cameras for frame_hits in hits]).amax(0, keepdim=True)
        outputs = self.outputs(bev, most_cameras)
        return outputs if previous_features is None else (*outputs, image_features.tokens)


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
