"""Boxes of a detector put into the bev frame: where on the ground, how large, and how likely.

Three distances are measured of each box: the ray of its foot meets the ground, and its height and its width are those
of an object of its class. All boxes of a frame tell by how much the ground slopes, or the vehicle pitches: a foot is
seen lower or higher than the height says. A small network weighs the distances, and corrects them and the score.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from bevcli.geometry.cameras import BEV_ORIGIN_M
from bevcli.model.image_boxes import IMAGE_CLASSES, ImageBoxes
from bevcli.model.road_slopes import RoadSlopes, adjugate_of_three

NAMES = {"person": "pedestrian"}  # names of classes that are other ones in images
# Of each image class: mean width, length and height of its objects, metres.
SIZES_WLH = (
    (0.7, 0.7, 1.75), (0.6, 1.7, 1.5), (1.9, 4.5, 1.65), (0.8, 2.1, 1.5), (2.9, 11.0, 3.4), (2.5, 7.0, 2.9),
    (0.5, 0.5, 1.0),
)  # fmt: skip
UNKNOWN = -5.0  # logit of a class that the detector does not have, before what is learned
NO_BOX = -20.0  # logit of all classes where there is no box
NEAREST_M, FARTHEST_M = 1.0, 100.0
OF_IMAGE, OF_RAYS = 7 + len(IMAGE_CLASSES), 15  # numbers that the network is told of a box


@dataclass(frozen=True)
class LiftConfig:
    """The lift."""

    width: int = 64  # channels of its two hidden layers
    feature_width: int = 16  # channels to which the features of the detector are reduced
    dropout: float = 0.2  # of these features, probability


class Lift(nn.Module):
    """From boxes in images to boxes in the bev frame."""

    sizes: Tensor
    known: Tensor

    def __init__(
        self, config: LiftConfig, classes: tuple[str, ...], channels: int = 128, ground_z: float = -BEV_ORIGIN_M[2]
    ) -> None:
        """classes: of the output. channels: of the features. ground_z: of the ground in the bev frame, metres."""
        super().__init__()
        self.ground_z = ground_z
        of_image = [NAMES.get(name, name) for name in IMAGE_CLASSES]
        known = torch.tensor([[float(name == each) for each in of_image] for name in classes])  # (classes, 7)
        self.register_buffer("known", known, persistent=False)
        self.register_buffer("sizes", torch.tensor(SIZES_WLH), persistent=False)
        self.dropout = nn.Dropout(config.dropout)
        self.reduce = nn.Linear(channels, config.feature_width)
        inputs = OF_IMAGE + OF_RAYS + config.feature_width
        self.tilt = nn.Sequential(nn.Linear(OF_IMAGE, 32), nn.ReLU(), nn.Linear(32, 2))
        self.network = nn.Sequential(
            nn.Linear(inputs, config.width), nn.ReLU(), nn.Linear(config.width, config.width), nn.ReLU(),
            nn.Linear(config.width, 12 + len(classes)),
        )  # fmt: skip
        self.class_scale = nn.Parameter(torch.ones(len(classes)))
        for last in (self.tilt[-1], self.network[-1]):
            for weights in last.parameters():
                nn.init.zeros_(weights)

    def forward(
        self, found: ImageBoxes, image_from_bev: Tensor, sizes: Tensor, slopes: RoadSlopes | None = None
    ) -> tuple[Tensor, Tensor, RoadSlopes]:
        """Class logits (B, N · K, classes), box codes (B, N · K, 10), and the slopes of the road that the boxes tell.

        The codes are those of `decoder.encode`, in the level bev frame of the vehicle; velocities are 0. A box that
        stands there once for each of several classes counts once.

        Args:
            found: boxes in pixels of the network's input.
            image_from_bev: (B, N, 4, 4), pixels of the network's input.
            sizes: (B, N, 2) width and height of the images in the network's input, without padding, pixels.
            slopes: that were expected; None where nothing is known.
        """
        logits = found.logits.float()
        is_box = (found.scores > 0) & (found.labels == logits.argmax(-1))  # (B, N, K)
        scores = logits.amax(-1).sigmoid() * is_box
        limit = sizes[:, :, None].float() - 0.5
        boxes = torch.minimum(found.boxes.float(), torch.cat([limit, limit], -1)).clamp(min=-0.5)
        rays = Rays(boxes, image_from_bev.float(), self.ground_z)
        mean = logits.softmax(-1) @ self.sizes  # (B, N, K, 3)
        distances = rays.distances(mean)
        extent = (boxes[..., 2:] - boxes[..., :2]).clamp(min=1.0)
        room = torch.cat([boxes[..., :2] + 0.5, limit - boxes[..., 2:]], -1)  # to the sides of the image
        aspect = (rays.chord / rays.rise).clamp(0.1, 10.0).log()
        of_image = [(room / 8).clamp(max=1), extent.log() - 4, aspect[..., None]]
        seen = torch.cat([*of_image, logits / 3], -1)
        slopes = self._slopes(seen, scores, rays, distances, slopes)
        along = rays.bearing
        tilt = (along * slopes.mean[:, None, None]).sum(-1)
        doubt = ((along[..., None, :] * slopes.covariance[:, None, None]).sum(-1) * along).sum(-1)  # variance of tilt
        level = rays.distances(mean, tilt)
        steps = [x[..., :1] - x[..., 1:2] for x in (distances, level)]
        features = self.reduce(self.dropout(found.features.float()))
        told = [seen, rays.numbers, distances - 2.5, level - 2.5, *steps, doubt[..., None].log() / 4 + 2.3, features]
        numbers = self.network(torch.cat([x.clamp(-4, 4) for x in told], -1))
        weights, place, correction = numbers.split([4, 8, len(self.known)], -1)
        # The first guess is the mean of the distances by foot and by height.
        weights = (weights + weights.new_tensor([2.0, 2.0, 0.0, -2.0])).softmax(-1)
        distance = ((weights * level).sum(-1) + place[..., 0]).clamp(max=5).exp()
        shift = place[..., 1] * rays.chord * distance  # to the left
        x = rays.camera[..., :1] + along[..., 0] * distance - along[..., 1] * shift
        y = rays.camera[..., 1:2] + along[..., 1] * distance + along[..., 0] * shift
        size = mean.log() + place[..., 2:5]
        z = self.ground_z + size[..., 2].exp() / 2 + place[..., 5]
        turn = torch.stack([place[..., 6], place[..., 7] + 0.1], -1)  # sine and cosine of yaw less that of the ray
        sin, cos = (turn / turn.square().sum(-1, keepdim=True).clamp(min=1e-4).sqrt()).unbind(-1)
        sin, cos = sin * along[..., 0] + cos * along[..., 1], cos * along[..., 0] - sin * along[..., 1]
        # The angle of a code is -yaw - pi / 2: its sine is -cos(yaw), its cosine -sin(yaw).
        codes = [x, y, size[..., 0], size[..., 1], z, size[..., 2], -cos, -sin, 0 * x, 0 * x]
        class_logits = self.class_scale * (logits @ self.known.T) + (1 - self.known.sum(-1)) * UNKNOWN + correction
        class_logits = class_logits - steps[1].abs()  # where foot and height disagree, one of them is wrong
        class_logits = torch.where(is_box[..., None], class_logits, NO_BOX)
        return class_logits.flatten(1, 2), torch.stack(codes, -1).flatten(1, 2), slopes

    def _slopes(
        self, seen: Tensor, scores: Tensor, rays: "Rays", distances: Tensor, expected: RoadSlopes | None
    ) -> RoadSlopes:
        """The slopes that fit all boxes and what was expected best.

        The network states of each box the logarithms of its true to its measured distance, and of its precision.
        """
        ratio, precision = self.tilt(seen).unbind(-1)
        drop = rays.height.clamp(min=0.3) * (0.15 + ratio - distances[..., 1]).clamp(-6, 2).exp()
        stated = (rays.foot_slope + drop).clamp(-0.1, 0.1)
        weights = scores * (4 + precision).clamp(max=8).exp() / (drop.square() + 1e-4)
        weighted = (rays.bearing * weights[..., None]).flatten(1, 2)  # (B, N · K, 2)
        pull = (weighted * stated.flatten(1, 2)[..., None]).sum(1)
        products = (weighted[..., None] * rays.bearing.flatten(1, 2)[..., None, :]).sum(1)
        return (expected or RoadSlopes.unknown(products.device)).joined(products, pull)


class Rays:
    """The rays of boxes (B, N, K, 4) in images. All attributes are (B, N, K) unless stated.

    Attributes:
        camera: (B, N, 3) place of the camera, bev frame, metres.
        height: of the camera above the ground, metres.
        bearing: (B, N, K, 2) direction on the ground of the middle of a box, of length 1.
        foot_slope, top_slope: of the rays of the lower and the upper edge; negative downwards.
        rise: the difference of these slopes.
        chord: of the directions of both sides on the ground: twice the sine of half their angle.
        numbers: (B, N, K, 4) the slopes, chord and height for a network.
    """

    def __init__(self, boxes: Tensor, image_from_bev: Tensor, ground_z: float) -> None:
        """boxes: pixels. image_from_bev: (B, N, 4, 4), pixels. ground_z: of the ground in the bev frame, metres."""
        inverse = adjugate_of_three(image_from_bev[..., :3, :3])  # its positive determinant scales all rays
        determinant = (image_from_bev[..., 0, :3] * inverse[..., 0]).sum(-1, keepdim=True)
        self.camera = -(inverse * image_from_bev[..., None, :3, 3]).sum(-1) / determinant
        left, top, right, bottom = boxes.unbind(-1)

        def ray(u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
            """Direction on the ground (B, N, K, 2), of length 1, and the slope."""
            way = (inverse[:, :, None] * torch.stack([u, v, torch.ones_like(u)], -1)[..., None, :]).sum(-1)
            flat = way[..., :2].square().sum(-1).sqrt().clamp(min=1e-6)
            return way[..., :2] / flat[..., None], (way[..., 2] / flat).clamp(-3, 3)

        self.bearing, self.foot_slope = ray((left + right) / 2, bottom)
        _, self.top_slope = ray((left + right) / 2, top)
        self.rise = (self.top_slope - self.foot_slope).clamp(min=0.01)
        self.chord = (ray(left, bottom)[0] - ray(right, bottom)[0]).square().sum(-1).sqrt().clamp(min=1e-3)
        self.height = (self.camera[..., 2:] - ground_z).expand_as(left)
        self.numbers = torch.stack([2 * self.foot_slope, 2 * self.top_slope, 2 * self.chord, self.height], -1)

    def distances(self, size: Tensor, tilt: Tensor | float = 0.0) -> Tensor:
        """(B, N, K, 4) logarithms of metres: by the foot, by the height, by the width, by the upper edge alone.

        size: (B, N, K, 3) width, length and height of the objects, metres. tilt: slope of the ground along the rays.
        """
        height, slope = size[..., 2], self.top_slope - tilt
        above = height - self.height
        top = torch.where(above * slope > 1e-3, above / torch.where(slope.abs() < 1e-3, 1e-3, slope), FARTHEST_M)
        foot = self.height / (tilt - self.foot_slope).clamp(min=0.01)
        parts = [foot, height / self.rise, size[..., :2].mean(-1) / self.chord, top]
        return torch.stack(parts, -1).clamp(NEAREST_M, FARTHEST_M).log()
