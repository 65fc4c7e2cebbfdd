"""Hybrid object queries: boxes in the images, put on the ground, become queries of their own beside the learned ones.

BEVFormerV2 (Yang et al. 2023) calls so the queries of its second stage that come from the first. Here the first stage
is a detector of photographs and `Lift`, which knows from the box where its object stands. They pass no layers of the
decoder: the learned queries say what the BEV map knows, and which of both is believed is weighed in each frame.
"""

from dataclasses import dataclass
from itertools import product

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from bevcli.geometry.bev_grid import BevGrid
from bevcli.model.image_boxes import IMAGE_CLASSES, ImageBoxes, rows
from bevcli.model.lift import NO_BOX, Lift, LiftConfig
from bevcli.model.pillar_projection import project_points
from bevcli.model.road_slopes import RoadSlopes, levelled
from bevcli.model.upload import upload_together
from bevcli.parsing.documents import Count, CountOrNone

GROUP_COUNT = 4
# Classes that the detector tells apart well, in groups: 0 those that it does not know, vehicles, people, cycles.
GROUPS = {
    **dict.fromkeys(("car", "bus", "truck", "trailer"), 1),
    **dict.fromkeys(("person", "pedestrian"), 2),
    **dict.fromkeys(("bicycle", "motorcycle"), 3),
}
SURE, SMALLEST = 0.35, 14.0  # score and height in pixels from which on a box in an image must be explained
EXPLAINED = 0.2, 0.6  # intersection over union with a learned box, from none to all of it explained
CLAIMED = 0.35  # score of the learned box that explains all of it
EXPECTED, PRIOR = 0.2, 3.0  # share that is explained before anything was seen, and the sum of scores that this weighs
TRUSTED = 0.28, 0.38  # share of explained boxes, from no to full trust in the learned queries
DOUBT, YIELD = 2.0, 3.0  # taken from the logits of learned queries without trust, and of hybrid ones with full trust
NEAREST_M = 0.3  # of the corners of a box that a camera sees


@dataclass(frozen=True)
class HybridQueriesConfig:
    """The [hybrid_queries] table of a model with a detector."""

    count: CountOrNone = 0  # of queries, the best boxes of all cameras; 0 for none
    # whether the rig of each frame is levelled first, by the slope of the road that the boxes tell, where the detector
    # stands beside the backbone: the vehicle pitches and rolls, and poses rarely state it
    level: bool = False
    features: Count = 128  # channels of the detector's maps


class HybridQueries(nn.Module):
    """Lifted boxes, as queries beside the learned ones."""

    range_start: Tensor
    range_extent: Tensor
    of_image: Tensor  # (7, groups)
    of_class: Tensor  # (classes, groups)

    def __init__(self, config: HybridQueriesConfig, classes: tuple[str, ...], grid: BevGrid, height_m: float) -> None:
        """Random weights. height_m: of the bev frame above the ground."""
        super().__init__()
        self.config = config
        self.lift = Lift(LiftConfig(), classes, config.features, -height_m)
        of_image, of_class = ([GROUPS.get(name, 0) for name in names] for names in (IMAGE_CLASSES, classes))
        self.register_buffer("of_image", torch.eye(GROUP_COUNT)[of_image], persistent=False)
        self.register_buffer("of_class", torch.eye(GROUP_COUNT)[of_class], persistent=False)
        ranges = torch.tensor([grid.x_range_m, grid.y_range_m])
        self.register_buffer("range_start", ranges[:, 0], persistent=False)
        self.register_buffer("range_extent", ranges[:, 1] - ranges[:, 0], persistent=False)

    @torch.no_grad()
    def forward(
        self, boxes: ImageBoxes, image_from_bev: Tensor, sizes: Tensor, slopes: RoadSlopes | None = None
    ) -> tuple[Tensor, Tensor]:
        """Class logits (B, H, classes) and box codes (B, H, 10) of the hybrid queries.

        Args:
            boxes: of N cameras.
            image_from_bev: (B, N, 4, 4), bev metres to pixels of the network's input.
            sizes: (B, N, 2) width and height of the images within their padding, pixels.
            slopes: of the road that were expected, see `Lift`.
        """
        logits, codes, _ = self.lift(boxes, image_from_bev, sizes, slopes)
        place = (codes[..., :2] - self.range_start) / self.range_extent
        logits = logits.where(((place > 0) & (place < 1)).all(-1, keepdim=True), NO_BOX)
        missing = max(self.config.count - logits.shape[1], 0)  # of few cameras
        logits, codes = (F.pad(x, (0, 0, 0, missing), value=fill) for x, fill in ((logits, NO_BOX), (codes, 0.0)))
        best, index = logits.amax(-1).topk(self.config.count)
        return rows(logits, index), rows(codes, index).where(best[..., None] > NO_BOX, 0.0)

    @torch.no_grad()
    def levelled(
        self, boxes: ImageBoxes, cameras: tuple[Tensor, Tensor, RoadSlopes | None], horizon: RoadSlopes | None = None
    ) -> tuple[Tensor, RoadSlopes, RoadSlopes | None]:
        """(B, N, 4, 4), see `levelled`, and the slopes of the road, both on the CPU; and the slopes without the boxes.

        cameras: image_from_bev, sizes and slopes, see `forward`; on the CPU. horizon: the slopes that it tells.
        """
        image_from_bev, sizes, expected = upload_together(cameras, boxes.boxes.device)
        told = self.lift(boxes, image_from_bev, sizes, expected)[-1]
        if horizon is not None:
            measured = horizon.measured(told)
            told = told.joined(*measured)
            expected = (expected or RoadSlopes.unknown(told.mean.device)).joined(*measured)
        told = told.to(cameras[0].device)
        return levelled(cameras[0], told, -self.lift.ground_z), told, expected

    def weighed(
        self, outputs: tuple[Tensor, Tensor], hybrid_logits: Tensor, boxes: ImageBoxes, cameras: tuple[Tensor, Tensor]
    ) -> tuple[Tensor, Tensor]:
        """The logits of the learned and of the hybrid queries, weighed by the trust in the learned ones.

        Where these explain what the detector sees, as on renderings, their places are the better ones; where they do
        not, as on photographs, those that start from its boxes are.

        Args:
            outputs: logits (L, B, Q, classes) and box codes (L, B, Q, 10) of the learned queries.
            hybrid_logits: (B, H, classes).
            boxes: of N cameras.
            cameras: image_from_bev of the rig that made the BEV map, and sizes, see `forward`.
        """
        logits, codes = outputs
        with torch.no_grad():
            explained, all_of_them = self.explained(logits[-1], codes[-1], boxes, *cameras)
            share = (explained + EXPECTED * PRIOR) / (all_of_them + PRIOR)
            trust = between(share, *TRUSTED)[:, None, None]
        return logits - DOUBT * (1 - trust), hybrid_logits - YIELD * trust

    def explained(
        self, logits: Tensor, codes: Tensor, boxes: ImageBoxes, image_from_bev: Tensor, sizes: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The sum of the scores of the boxes in images that learned boxes explain, and that of all of them, (B,) each.

        logits: (B, Q, classes). codes: (B, Q, 10). Others: see `forward`.
        """
        rectangles, is_seen = rectangles_of(codes, image_from_bev, sizes)  # (B, N, Q, 4), (B, N, Q)
        of_box = self.of_image[boxes.labels]  # (B, N, K, groups)
        claims = (logits.float().sigmoid() @ self.of_class)[:, None] @ of_box.transpose(-1, -2)  # (B, N, Q, K)
        overlap = between(intersection_over_union(rectangles, boxes.boxes), *EXPLAINED) * is_seen[..., None]
        explained = (overlap * between(claims, 0.0, CLAIMED)).amax(2)  # (B, N, K)
        start, end = boxes.boxes.split(2, -1)
        is_whole = ((start > 1) & (end < sizes[:, :, None] - 2.5)).all(-1)
        counts = is_whole & (end - start)[..., 1].gt(SMALLEST) & boxes.scores.gt(SURE) & of_box[..., 0].eq(0)
        weights = boxes.scores * counts
        return (weights * explained).sum((1, 2)), weights.sum((1, 2))


def between(x: Tensor, none: float, full: float) -> Tensor:
    """0 up to `none`, 1 from `full` on, and straight between them."""
    return ((x - none) / (full - none)).clamp(0, 1)


def rectangles_of(codes: Tensor, image_from_bev: Tensor, sizes: Tensor) -> tuple[Tensor, Tensor]:
    """The rectangles (B, N, Q, 4) around boxes in the images, clipped, and whether a camera sees them (B, N, Q).

    A camera sees a box that lies before it and of whose rectangle at least a third is in the image. codes: (B, Q, 10).
    """
    x, y, width, length, z, height, sin, cos, *_ = codes.float().unbind(-1)
    forward, left, up = (size.clamp(max=4).exp() / 2 for size in (length, width, height))
    norm = (sin.square() + cos.square()).sqrt().clamp(min=1e-4)
    cos_yaw, sin_yaw = -sin / norm, -cos / norm  # the angle of a code is -yaw - pi / 2
    places = [
        (x + i * forward * cos_yaw - j * left * sin_yaw, y + i * forward * sin_yaw + j * left * cos_yaw, z + k * up)
        for i, j, k in product((-1, 1), repeat=3)
    ]
    corners = torch.stack([torch.stack(place, -1) for place in places], -2)[:, None]  # (B, 1, Q, 8, 3)
    pixels, depth = project_points(image_from_bev[:, :, None, None], corners)
    low, high, limit = pixels.amin(-2), pixels.amax(-2), sizes[:, :, None] - 0.5
    whole = (high - low).prod(-1)
    low, high = (torch.minimum(corner.clamp(min=-0.5), limit) for corner in (low, high))
    inside = (high - low).prod(-1)
    return torch.cat([low, high], -1), (depth > NEAREST_M).all(-1) & (inside > 0.3 * whole) & (inside > 16)


def intersection_over_union(a: Tensor, b: Tensor) -> Tensor:
    """(..., Q, K) of rectangles (..., Q, 4) and (..., K, 4)."""
    a, b = a[..., :, None, :], b[..., None, :, :]
    low, high = torch.maximum(a[..., :2], b[..., :2]), torch.minimum(a[..., 2:], b[..., 2:])
    shared = (high - low).clamp(min=0).prod(-1)
    areas = [(x[..., 2:] - x[..., :2]).clamp(min=0).prod(-1) for x in (a, b)]
    return shared / (areas[0] + areas[1] - shared).clamp(min=1e-3)
