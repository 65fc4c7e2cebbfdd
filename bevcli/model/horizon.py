"""The slopes of the road relative to the vehicle, by what the images show around the horizon.

A ring of rays all around the vehicle, level in the bev frame, samples the images. A small network slides along it and
tells for each direction how far above its middle the horizon of the road lies, by how much it rises to the left there,
and how sure both are. The slopes are those that fit all directions best. `tests/tools/horizon.py` trains the network,
on renderings.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from bevcli.model.road_slopes import RoadSlopes

ROWS, COLUMNS, STEP_DEG = 112, 1440, 0.25  # of the ring, and between two of either
FOLD = 8  # columns of the ring to a direction of the network
UNIT = 0.02  # of the slopes that the network states
INSIDE = 2.0  # pixels between what a camera sees and the edges of its image


def angles(count: int) -> Tensor:
    """Of so many rows or columns of the ring, radians, rising and about 0."""
    return torch.deg2rad(STEP_DEG * (torch.arange(count) - (count - 1) / 2))


class Ring(nn.Module):
    """Where the rays of the ring lie in the images of a rig."""

    rays: Tensor

    def __init__(self, rows: int = ROWS) -> None:
        super().__init__()
        self.rows = rows
        up, around = torch.meshgrid(-angles(rows), angles(COLUMNS), indexing="ij")
        rays = torch.stack([up.cos() * around.cos(), up.cos() * around.sin(), up.sin()]).flatten(1)
        self.register_buffer("rays", rays, persistent=False)  # (3, rows · COLUMNS)

    def forward(self, image_from_bev: Tensor, image_size: tuple[int, int]) -> Tensor:
        """Places (B, rows, COLUMNS, 2) in the images, one below the other, each in the camera that sees most around it.

        They are as `grid_sample` takes them, outside where no camera sees the ray.

        image_from_bev: (B, N, 4, 4), pixels. image_size: (height, width) of the network's input, pixels.
        """
        (height, width), cameras = image_size, image_from_bev.shape[1]
        x, y, depth = (image_from_bev[..., :3, :3] @ self.rays).unbind(-2)  # (B, N, rows · COLUMNS)
        x, y = x / depth.clamp(min=1e-3), y / depth.clamp(min=1e-3)
        room = torch.minimum(x, width - 1 - x)  # to the sides of the image
        seen = (depth > 1e-3) & (torch.minimum(y, height - 1 - y) > INSIDE)
        room, camera = room.where(seen, 0.0).max(1, keepdim=True)
        x, y = x.gather(1, camera), y.gather(1, camera) + height * camera
        places = torch.cat([(2 * x + 1) / width - 1, (2 * y + 1) / (height * cameras) - 1], 1)
        return places.where(room > INSIDE, 2.0).movedim(1, -1).unflatten(1, (self.rows, COLUMNS))


class Horizon(nn.Module):
    """The slopes of the road by a network on the ring. It has no loss: a training of the model leaves it as it is."""

    told: Tensor

    def __init__(self) -> None:
        """Random weights, with which all slopes are 0."""
        super().__init__()
        self.ring = Ring()
        layers: list[nn.Module] = []
        rows, channels = ROWS, 2
        for outputs, size, stride in ((16, 5, 2), (32, 3, 2), (48, 3, 2), (48, 3, 1)):
            layers += [Around(size), nn.Conv2d(channels, outputs, size, stride, padding=(size // 2, 0)), nn.ReLU()]
            rows, channels = rows // stride, outputs
        layers += [Around(3), nn.Conv2d(channels, 96, (rows, 3)), nn.ReLU()]
        layers += [nn.Conv2d(96, 64, 1), nn.ReLU(), nn.Conv2d(64, 4, 1)]
        self.network = nn.Sequential(*layers)
        nn.init.zeros_(layers[-1].weight)  # type: ignore[arg-type]
        nn.init.zeros_(layers[-1].bias)  # type: ignore[arg-type]
        self.log_shares = nn.Parameter(torch.full((2, 1), -4.0))  # of the precisions: neighbours err alike
        around = angles(COLUMNS)
        ahead, left = (wave.unflatten(0, (-1, FOLD)).mean(1) for wave in (around.cos(), around.sin()))
        told = torch.stack([torch.stack([ahead, left], -1), torch.stack([-left, ahead], -1)])
        self.register_buffer("told", told, persistent=False)  # (2, COLUMNS / FOLD, 2), what each slope adds to both
        self.requires_grad_(False)

    def forward(self, images: Tensor, image_from_bev: Tensor) -> RoadSlopes:
        """The slopes in the bev frame.

        images: (B, N, 3, H, W), normalised; zero in their padding, and where an image is missing. image_from_bev:
        (B, N, 4, 4), bev metres to pixels of these images.
        """
        return self.slopes(*self.rises(*self.view(images, image_from_bev)))

    def view(self, images: Tensor, image_from_bev: Tensor) -> tuple[Tensor, Tensor]:
        """The ring in grey, and where a camera sees it (1, else 0), (B, ROWS, COLUMNS) each.

        Arguments: see `forward`.
        """
        height, width = images.shape[-2:]
        grey = images.mean(2).flatten(1, 2)  # (B, N · H, W)
        maps = torch.stack([grey, grey.ne(0).to(grey.dtype)], 1)
        ring, seen = F.grid_sample(maps, self.ring(image_from_bev, (height, width)), align_corners=False).unbind(1)
        return ring, seen.gt(0.99).to(ring.dtype)

    def rises(self, ring: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
        """How high the horizon lies in each direction and how it rises to the left, and logarithms of the errors.

        Both (B, 2, COLUMNS / FOLD), as slopes and of them in `UNIT`s; the errors are infinite where no camera looks.
        Arguments: of `view`.
        """
        count = seen.sum((1, 2), keepdim=True).clamp(min=1)
        ring = (ring - (ring * seen).sum((1, 2), keepdim=True) / count) * seen
        spread = (ring.square().sum((1, 2), keepdim=True) / count).sqrt() + 0.02
        stated = self.network(torch.stack([ring / spread, seen], 1))[:, :, 0].unflatten(1, (2, 2))
        looks = seen.amax(1).unflatten(-1, (-1, FOLD)).amax(-1)[:, None]
        errors = 4 * torch.tanh(stated[:, :, 1] / 4) - 1
        return stated[:, :, 0] * UNIT, errors.where(looks > 0, math.inf)

    def slopes(self, rises: Tensor, log_errors: Tensor) -> RoadSlopes:
        """The slopes that fit all directions best. Arguments: of `rises`."""
        weights = (self.log_shares - 2 * log_errors).exp() / UNIT**2
        weighted = (weights[..., None] * self.told).flatten(1, 2)  # (B, 2 · COLUMNS / FOLD, 2)
        information = weighted.transpose(1, 2) @ self.told.flatten(0, 1)
        return RoadSlopes.unknown(weights.device).joined(information, (weighted * rises.flatten(1)[..., None]).sum(1))


class Around(nn.Module):
    """Columns of the other end on either side, for a convolution of so many: the ring is closed."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self.columns = size // 2

    def forward(self, x: Tensor) -> Tensor:
        """x: (B, C, rows, columns). By operations that engines have: OpenVINO lacks circular padding."""
        return torch.cat([x[..., -self.columns :], x, x[..., : self.columns]], -1)
