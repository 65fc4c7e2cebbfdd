"""Boxes of a 2D detector put into the bev frame: where on the ground, how large, and how likely.

One camera at a time. Three distances are measured: the ray of the foot meets the ground, and the height and the width
of a box fit an object of its class. A small network weighs them, corrects them, and corrects the score.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from bevcli.geometry.cameras import BEV_ORIGIN_M

# Mean width, length and height of an object, metres, by image class (person, bicycle, car, motorcycle, bus, truck,
# traffic light), and the class of boxes that it becomes.
SIZES_WLH = ((0.7, 0.7, 1.75), (0.6, 1.7, 1.5), (1.9, 4.5, 1.65), (0.8, 2.1, 1.5), (2.9, 11.0, 3.4), (2.5, 7.0, 2.9), (0.5, 0.5, 1.0))  # fmt: skip
CLASSES = ("pedestrian", "bicycle", "car", "motorcycle", "bus", "truck", "")
NOT_SEEN = -5.0  # logit of a class that the detector does not know, before what is learned
NEAREST_M, FARTHEST_M = 1.0, 100.0
TILT_SPREAD = 0.016  # standard deviation of the slope of the ground under a vehicle, by pitch and roll


@dataclass(frozen=True)
class LiftConfig:
    """The lift.

    Attributes:
        width: channels of its two hidden layers.
        feature_width: channels to which the features of the detector are reduced; 0 leaves them out.
        dropout: of these features, probability.
    """

    width: int = 64
    feature_width: int = 16
    dropout: float = 0.2


class BoxGeometry:
    """Rays and distances of boxes (B, N, K, 4) in images. All results are (B, N, K) unless stated.

    Attributes:
        camera: (B, N, 3) place of the camera, bev frame, metres.
        height: of the camera above the ground, metres.
        bearing: (B, N, K, 2) direction on the ground of the middle of a box, of length 1.
        foot_slope, top_slope: of the rays of the lower and the upper edge; negative downwards.
        chord: twice the sine of half the angle between the rays of the sides.
    """

    def __init__(self, boxes: Tensor, image_from_bev: Tensor, ground_z: float) -> None:
        """boxes: pixels. image_from_bev: (B, N, 4, 4), pixels. ground_z: of the ground in the bev frame, metres."""
        r0, r1, r2 = image_from_bev[..., :3, :3].unbind(-2)  # (B, N, 3)
        # Columns of the adjugate matrix; the determinant is positive, and scales all rays alike.
        inverse = torch.stack([_cross(r1, r2), _cross(r2, r0), _cross(r0, r1)], -1)  # (B, N, 3, 3)
        determinant = (r0 * inverse[..., 0]).sum(-1)
        self.camera = -(inverse * image_from_bev[..., None, :3, 3]).sum(-1) / determinant[..., None]
        self.height = (self.camera[..., 2:] - ground_z).expand(boxes.shape[:-1])
        left, top, right, bottom = boxes.unbind(-1)
        middle = (left + right) / 2

        def ray(u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
            """Direction on the ground (B, N, K, 2), of length 1, and the slope."""
            pixel = torch.stack([u, v, torch.ones_like(u)], -1)
            way = (inverse[:, :, None] * pixel[..., None, :]).sum(-1)
            flat = way[..., :2].square().sum(-1, keepdim=True).sqrt().clamp(min=1e-6)
            return way[..., :2] / flat, (way[..., 2] / flat[..., 0]).clamp(-3, 3)

        self.bearing, self.foot_slope = ray(middle, bottom)
        _, self.top_slope = ray(middle, top)
        start, end = ray(left, bottom)[0], ray(right, bottom)[0]
        self.chord = (end - start).square().sum(-1).sqrt().clamp(min=1e-3)

    def distances(self, width: Tensor, height: Tensor, tilt: Tensor | float = 0.0) -> Tensor:
        """(B, N, K, 4) logarithms of metres: by the foot, by the height, by the width, by the top alone.

        width, height: of the objects, metres. tilt: of the ground along the rays.
        """
        foot = self.height / (tilt - self.foot_slope).clamp(min=0.01)
        tall = height / (self.top_slope - self.foot_slope).clamp(min=0.01)
        above, slope = height - self.height, self.top_slope - tilt
        top = torch.where(above * slope > 1e-3, above / torch.where(slope.abs() < 1e-3, 1e-3, slope), FARTHEST_M)
        return torch.stack([foot, tall, width / self.chord, top], -1).clamp(NEAREST_M, FARTHEST_M).log()


class GroundTilt(nn.Module):
    """Slope of the ground relative to the vehicle, of which all boxes of a frame tell: a foot is seen lower down, or
    higher up, than the height of its object says.

    Each box states a slope along its ray, and how sure it is; the slopes in x and y follow by least squares.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.network = nn.Sequential(nn.Linear(channels, 32), nn.ReLU(), nn.Linear(32, 2))
        nn.init.zeros_(self.network[-1].weight)
        nn.init.zeros_(self.network[-1].bias)

    def forward(self, known: Tensor, scores: Tensor, geometry: BoxGeometry, distances: Tensor) -> tuple[Tensor, Tensor]:
        """The slopes (B, 2) along x and y, and their covariance (B, 2, 2).

        known: (B, N, K, C). scores: (B, N, K). distances: (B, N, K, 4).
        """
        ratio, sure = self.network(known).unbind(-1)
        expected = geometry.height.clamp(min=0.3) * (0.15 + ratio - distances[..., 1]).exp()  # slope of a level ground
        weights = scores * (4 + sure).clamp(max=8).exp() / (expected.square() + 1e-4)
        stated = (geometry.foot_slope + expected).clamp(-0.1, 0.1)
        along = geometry.bearing.flatten(1, 2)  # (B, N · K, 2)
        weighted = along * weights.flatten(1, 2)[..., None]
        xx, xy, yy = ((weighted[..., i] * along[..., j]).sum(-1) for i, j in ((0, 0), (0, 1), (1, 1)))
        xx, yy = xx + TILT_SPREAD**-2, yy + TILT_SPREAD**-2  # the slopes that are likely without any box
        x, y = (weighted * stated.flatten(1, 2)[..., None]).sum(1).unbind(-1)
        determinant = xx * yy - xy * xy
        covariance = torch.stack([torch.stack([yy, -xy], -1), torch.stack([-xy, xx], -1)], -2) / determinant[:, None, None]
        return (covariance * torch.stack([x, y], -1)[:, None]).sum(-1), covariance


class Lift(nn.Module):
    """From boxes in images to boxes in the bev frame."""

    sizes: Tensor
    base: Tensor

    def __init__(self, config: LiftConfig, classes: tuple[str, ...], channels: int = 128, ground_z: float = -BEV_ORIGIN_M[2]) -> None:  # fmt: skip
        """classes: of the output. channels: of the features. ground_z: of the ground in the bev frame, metres."""
        super().__init__()
        self.ground_z = ground_z
        of_image = torch.tensor([[float(name == known) for known in CLASSES] for name in classes])  # (classes, 7)
        self.register_buffer("base", of_image, persistent=False)
        self.register_buffer("sizes", torch.tensor(SIZES_WLH), persistent=False)
        self.dropout = nn.Dropout(config.dropout)
        self.reduce = nn.Linear(channels, config.feature_width) if config.feature_width else None
        width, known = config.width, 19 + len(CLASSES) + config.feature_width
        self.tilt = GroundTilt(known)
        self.network = nn.Sequential(
            nn.Linear(known + 6, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU(),
            nn.Linear(width, 4 + 8 + len(classes)),
        )  # fmt: skip
        self.class_scale = nn.Parameter(torch.ones(len(classes)))
        nn.init.zeros_(self.network[-1].weight)
        nn.init.zeros_(self.network[-1].bias)

    def forward(
        self, boxes: Tensor, logits: Tensor, features: Tensor, image_from_bev: Tensor, image_size: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Class logits (B, N · K, classes) and box codes (B, N · K, 10) as `decoder.encode` has them; velocities are 0.

        Args:
            boxes: (B, N, K, 4) left, top, right, bottom in pixels of the network's image.
            logits: (B, N, K, 7) of the image classes.
            features: (B, N, K, C) of the detector at the boxes.
            image_from_bev: (B, N, 4, 4), pixels of the network's image.
            image_size: (B, N, 2) width and height of the images in the network's input, without padding, pixels.
        """
        boxes, logits, image_from_bev = boxes.float(), logits.float(), image_from_bev.float()
        geometry = BoxGeometry(boxes, image_from_bev, self.ground_z)
        mean = logits.softmax(-1) @ self.sizes  # (B, N, K, 3)
        wide, tall = mean[..., :2].mean(-1), mean[..., 2]
        distances = geometry.distances(wide, tall)
        known = self._known(boxes, logits, image_size, geometry, distances)
        if self.reduce is not None:
            known = torch.cat([known, self.reduce(self.dropout(features.float()))], -1)
        slopes, covariance = self.tilt(known, logits.amax(-1).sigmoid(), geometry, distances)
        self.slopes = slopes
        along = geometry.bearing
        tilt = (along * slopes[:, None, None]).sum(-1)
        doubt = ((along[..., None, :] * covariance[:, None, None]).sum(-1) * along).sum(-1)  # its variance
        level = geometry.distances(wide, tall, tilt)
        told = [level - 2.5, (level[..., :1] - level[..., 1:2]).clamp(-3, 3), doubt[..., None].log() / 4 + 2.3]
        weights, place, correction = self.network(torch.cat([known, *told], -1)).split([4, 8, len(self.base)], -1)
        # The first guess is the mean of the distances by foot and by height.
        weights = (weights + weights.new_tensor([2.0, 2.0, 0.0, -2.0])).softmax(-1)
        distance = ((weights * level).sum(-1) + place[..., 0]).exp().clamp(max=2 * FARTHEST_M)
        across = torch.stack([-along[..., 1], along[..., 0]], -1)
        shift = place[..., 1] * geometry.chord * distance
        flat = geometry.camera[:, :, None, :2] + along * distance[..., None] + across * shift[..., None]
        size = mean.log() + place[..., 2:5]
        up = self.ground_z + size[..., 2].exp() / 2 + place[..., 5]
        turn = torch.stack([place[..., 6], place[..., 7] + 0.1], -1)  # sin, cos of the yaw from the ray's
        turn = turn / turn.square().sum(-1, keepdim=True).sqrt().clamp(min=1e-3)
        cos = along[..., 0] * turn[..., 1] - along[..., 1] * turn[..., 0]
        sin = along[..., 1] * turn[..., 1] + along[..., 0] * turn[..., 0]
        # The angle of a box code is -yaw - pi / 2: its sine is -cos(yaw), its cosine -sin(yaw).
        code = torch.stack(
            [flat[..., 0], flat[..., 1], size[..., 0], size[..., 1], up, size[..., 2], -cos, -sin, 0 * up, 0 * up], -1
        )
        unknown = 1 - self.base.sum(-1)
        scores = self.class_scale * (logits @ self.base.T) + unknown * NOT_SEEN + correction
        return scores.flatten(1, 2), code.flatten(1, 2)

    def _known(self, boxes: Tensor, logits: Tensor, image_size: Tensor, g: BoxGeometry, distances: Tensor) -> Tensor:
        """(B, N, K, 26) what the network is told of a box."""
        extent = (boxes[..., 2:] - boxes[..., :2]).clamp(min=1.0)
        room = torch.cat([boxes[..., :2], image_size[:, :, None] - boxes[..., 2:]], -1)  # to the sides of the image
        cut = (room / 8).clamp(-1, 1)
        slopes = torch.stack([g.foot_slope, g.top_slope, g.chord.clamp(max=2.0), g.height / 2], -1).clamp(-2, 2)
        steps = torch.stack([distances[..., 0] - distances[..., 1], distances[..., 2] - distances[..., 1],
                             g.foot_slope / g.chord, g.top_slope / g.chord], -1).clamp(-3, 3)  # fmt: skip
        hidden = hidden_feet(boxes, logits)[..., None]
        return torch.cat([distances - 2.5, steps, cut, slopes * 2, extent.log() - 4, hidden, logits / 3], -1)


def hidden_feet(boxes: Tensor, logits: Tensor) -> Tensor:
    """(B, N, K), 0 to 1: the share of the lower edge of a box that a nearer box of the image hides.

    Nearer is a box that reaches lower down; it counts by its score, and by how little the two overlap otherwise.
    """
    a, b = boxes[..., :, None, :], boxes[..., None, :, :]  # the one that is hidden, the one that hides it
    both = (torch.minimum(a[..., 2:], b[..., 2:]) - torch.maximum(a[..., :2], b[..., :2])).clamp(min=0)  # (B, N, K, K, 2)
    area = (boxes[..., 2:] - boxes[..., :2]).clamp(min=1).prod(-1)
    inside = both.prod(-1)
    overlap = inside / (area[..., :, None] + area[..., None, :] - inside)
    nearer = (b[..., 3] > a[..., 3] + 2) & (b[..., 1] < a[..., 3])
    share = both[..., 0] / (a[..., 2] - a[..., 0]).clamp(min=1)
    return (nearer * share * (1 - overlap) * logits.amax(-1).sigmoid()[..., None, :]).amax(-1)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    """The cross product (..., 3)."""
    (a0, a1, a2), (b0, b1, b2) = a.unbind(-1), b.unbind(-1)
    return torch.stack([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0], -1)
