"""Hybrid object queries: boxes in the images, put on the ground, become queries of their own beside the learned ones.

BEVFormerV2 (Yang et al. 2023) calls so the queries of its second stage that come from the first. Here the first stage
is a detector of photographs and `Lift`, which knows from the box where its object stands. The queries start as these
boxes; what the layers read of the BEV map (the ground, other cameras, the history) only corrects them.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from bevcli.geometry.bev_grid import BevGrid
from bevcli.model.decoder import BOX_CODE_SIZE, DecoderConfig, DecoderLayer, branch
from bevcli.model.image_boxes import IMAGE_CLASSES, ImageBoxes, rows
from bevcli.model.lift import NO_BOX, Lift, LiftConfig
from bevcli.model.pillar_projection import project_points

# Classes that the detector tells apart well, in groups: 0 those that it does not know, vehicles, people, cycles.
GROUPS = {
    **dict.fromkeys(("car", "bus", "truck", "trailer"), 1),
    **dict.fromkeys(("person", "pedestrian"), 2),
    **dict.fromkeys(("bicycle", "motorcycle"), 3),
}
# Logarithms of the shares that it misses, by group: of rendered cars a third, of people a seventh.
MISSED = (0.0, -1.1, -1.9, -1.1)
MARGIN, SURE = 0.15, 0.3  # of the sides of a box, in which an object's centre lies; score that counts as found
RANGE_SCALE = 0.05  # of metres, as they enter a layer


@dataclass(frozen=True)
class HybridQueriesConfig:
    """The [hybrid_queries] table of a model whose backbone is a detector.

    Attributes:
        count: of queries, the best boxes of all cameras; 0 for none.
        layers: that correct them by the BEV map; with 0 they stay as `Lift` gives them.
        features: channels of the backbone's maps.
    """

    count: int = 0
    layers: int = 0
    features: int = 128

    def __post_init__(self) -> None:
        if self.count < 0 or self.layers < 0 or self.features < 1:
            raise ValueError("count and layers must be 0 or more, features 1 or more")


class HybridQueries(nn.Module):
    """Lifted boxes, corrected by what the BEV map knows. Without training they stay as `Lift` gives them."""

    range_start: Tensor
    range_extent: Tensor
    of_image: Tensor  # (7, groups)
    of_class: Tensor  # (classes, groups)
    missed: Tensor  # (groups,)

    def __init__(
        self,
        config: HybridQueriesConfig,
        decoder: DecoderConfig,
        channels: int,
        classes: tuple[str, ...],
        grid: BevGrid,
        height_m: float,
    ) -> None:
        """Random weights, without effect. height_m: of the bev frame above the ground."""
        super().__init__()
        self.config, shape = config, (grid.rows, grid.columns)
        self.lift = Lift(LiftConfig(), classes, config.features, -height_m)
        self.layers = nn.ModuleList(DecoderLayer(decoder, channels, shape) for _ in range(config.layers))
        if config.layers:
            self.content = nn.Linear(config.features + len(IMAGE_CLASSES) + len(classes), channels)
            self.position = branch(BOX_CODE_SIZE, 1, channels)
            self.class_correction = nn.Linear(channels, len(classes))
            self.box_correction = nn.Linear(channels, BOX_CODE_SIZE)
            for weights in (*self.class_correction.parameters(), *self.box_correction.parameters()):
                nn.init.zeros_(weights)
        of_image, of_class = ([GROUPS.get(name, 0) for name in names] for names in (IMAGE_CLASSES, classes))
        self.register_buffer("of_image", torch.eye(len(MISSED))[of_image], persistent=False)
        self.register_buffer("of_class", torch.eye(len(MISSED))[of_class], persistent=False)
        self.register_buffer("missed", torch.tensor(MISSED), persistent=False)
        ranges = torch.tensor([grid.x_range_m, grid.y_range_m])
        self.register_buffer("range_start", ranges[:, 0], persistent=False)
        self.register_buffer("range_extent", ranges[:, 1] - ranges[:, 0], persistent=False)

    def forward(self, bev: Tensor, boxes: ImageBoxes, image_from_bev: Tensor, sizes: Tensor) -> tuple[Tensor, Tensor]:
        """Class logits (B, H, classes) and box codes (B, H, 10) of the hybrid queries.

        Args:
            bev: (B, Y·X, C).
            boxes: of N cameras.
            image_from_bev: (B, N, 4, 4), bev metres to pixels of the network's input.
            sizes: (B, N, 2) width and height of the images within their padding, pixels.
        """
        with torch.no_grad():
            logits, codes, _ = self.lift(boxes, image_from_bev, sizes)
            place = (codes[..., :2] - self.range_start) / self.range_extent
            is_inside = ((place > 0) & (place < 1)).all(-1, keepdim=True)
            logits = logits.where(is_inside, NO_BOX)
            missing = max(self.config.count - logits.shape[1], 0)  # of few cameras
            logits, codes, place = (
                F.pad(x, (0, 0, 0, missing), value=fill) for x, fill in ((logits, NO_BOX), (codes, 0.0), (place, 0.0))
            )
            best, index = logits.amax(-1).topk(self.config.count)
            logits, codes = rows(logits, index), rows(codes, index).where(best[..., None] > NO_BOX, 0.0)
            place = rows(place, index).clamp(0, 1)
        if not self.config.layers:
            return logits, codes
        seen = rows(F.pad(torch.cat([boxes.features, boxes.logits], -1).flatten(1, 2), (0, 0, 0, missing)), index)
        query = self.content(torch.cat([seen, logits], -1))
        position = self.position(torch.cat([codes[..., :2] * RANGE_SCALE, codes[..., 2:]], -1))
        for layer in self.layers:
            query = layer(query, position, place, bev)
        return logits + self.class_correction(query), codes + self.box_correction(query)

    def weighed(
        self, class_logits: Tensor, box_codes: Tensor, boxes: ImageBoxes, image_from_bev: Tensor, sizes: Tensor
    ) -> Tensor:
        """The class logits (L, B, Q, classes) of other queries, lower where the detector looked and saw nothing.

        An object that a camera sees and its detector does not is one of those that it misses, or none: by Bayes' rule
        the logit falls by the logarithm of the share that it misses. box_codes: (L, B, Q, 10). Others: see `forward`.
        """
        x, y, _, _, z, *_ = box_codes[-1].float().unbind(-1)
        centers = torch.stack([x, y, z], -1)[:, None]  # (B, 1, Q, 3)
        place, depth = project_points(image_from_bev[:, :, None], centers)  # (B, N, Q, 2), (B, N, Q)
        tells = boxes.scores.amax(-1, keepdim=True) > 0  # an image in which nothing at all is found tells nothing
        is_seen = tells & (depth > 1) & (place > 0).all(-1) & (place < sizes[:, :, None]).all(-1)
        start, end = boxes.boxes[:, :, None].split(2, -1)  # (B, N, 1, K, 2)
        margin = MARGIN * (end - start)
        hit = ((place[..., None, :] > start - margin) & (place[..., None, :] < end + margin)).all(-1)  # (B, N, Q, K)
        sureness = (boxes.scores / SURE).clamp(max=1)[:, :, None] * hit
        found = (sureness[..., None] * self.of_image[boxes.labels][:, :, None]).amax((1, 3))  # (B, Q, groups)
        return class_logits + (self.missed * (1 - found) * is_seen.any(1)[..., None]) @ self.of_class.T
