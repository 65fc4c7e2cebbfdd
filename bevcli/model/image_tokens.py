"""Image features as tokens, with the embeddings of their camera, of their feature level and of their viewing ray."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from bevcli.model.deformable_attention import FeatureMaps, LevelShapes
from bevcli.model.upload import upload


@dataclass(frozen=True)
class ImageTokensConfig:
    """The embeddings that are added to image features."""

    camera_embedding: bool = True  # whether every image feature gets the learned embedding of its camera
    # number of learned level embeddings, at least the neck's levels (published weights hold four)
    level_embeddings: int = 4
    # whether every image feature gets an embedding of its viewing ray, see `CalibrationEmbedding`. The published models
    # have none
    calibration_embedding: bool = False


class ImageTokens(nn.Module):
    """Adds the camera embedding and the level embedding to the neck's maps and flattens the maps to tokens."""

    def __init__(self, cameras: int, channels: int, config: ImageTokensConfig) -> None:
        super().__init__()
        self.level_embedding = nn.Parameter(torch.randn(config.level_embeddings, channels))
        self.camera_embedding: nn.Parameter | None = None
        if config.camera_embedding:
            self.camera_embedding = nn.Parameter(torch.randn(cameras, channels))

    def forward(self, maps: Sequence[Tensor], camera_index: Tensor) -> FeatureMaps:
        """Tokens (B·N, S, C) of B·N images, in the maps' dtype; S is the number of cells of all levels.

        maps: (B·N, C, H_l, W_l), one a level. camera_index: (N,) or (B, N) int64, the camera embedding of each image.
        """
        level_shapes = tuple((x.shape[-2], x.shape[-1]) for x in maps)
        levels = [x.flatten(2).transpose(1, 2) + self.level_embedding[i] for i, x in enumerate(maps)]
        tokens = torch.cat(levels, dim=1)  # (B·N, S, C)
        if self.camera_embedding is not None:
            embedding = self.camera_embedding[camera_index]  # (N, C) or (B, N, C)
            by_camera = tokens.unflatten(0, (-1, camera_index.shape[-1])) + embedding[..., None, :]  # (B, N, S, C)
            tokens = by_camera.flatten(0, 1)  # (B·N, S, C)
        # Where the maps are in half precision, the sums with the embeddings are rounded once, here.
        return FeatureMaps(tokens.to(maps[0].dtype), level_shapes)


RAY_FEATURES = 9
HIDDEN = 64
# Units of the numbers that describe a ray, chosen so that they are about 1.
_METRES = 2.0  # of the camera's position
_FOCAL = 32.0  # of the focal length, in cells of a feature map
_NEAREST_M = 2.0  # distance to the ground: nearer points count as this near


class CalibrationEmbedding(nn.Module):
    """Scales and shifts every image feature by functions of its viewing ray.

    A small network sees the ray of the feature in the bev frame, the camera's position, its focal length in cells of
    the feature map, and the depth at which the ray meets the ground. With these the model can turn the size of an
    object in the image into a distance, for any camera, as BEVDepth and PETR do in other ways. The last layer starts
    at zero: an untrained embedding changes nothing.
    """

    def __init__(self, channels: int, height_m: float) -> None:
        """height_m: height of the bev frame above the ground, metres."""
        super().__init__()
        self.height_m = height_m
        self.layers = nn.Sequential(
            nn.Linear(RAY_FEATURES, HIDDEN), nn.GELU(), nn.Linear(HIDDEN, HIDDEN), nn.GELU(),
            nn.Linear(HIDDEN, 2 * channels),
        )  # fmt: skip
        for parameter in self.layers[-1].parameters():
            nn.init.zeros_(parameter)

    def forward(
        self, image_from_bev: Tensor, level_shapes: LevelShapes, image_size: tuple[int, int]
    ) -> tuple[Tensor, Tensor]:
        """The scale and the shift of image features, (B·N, S, C) float32 each; see `FeatureMaps.scaled`.

        Args:
            image_from_bev: (B, N, 4, 4) float32, bev metres to pixels of the network's input, on the CPU or the device.
            level_shapes: (rows, columns) of each feature map.
            image_size: (height, width) of the network's input, pixels.
        """
        device = next(self.layers.parameters()).device
        # In float32: half precision is too coarse for rays.
        with torch.autocast(device.type, enabled=False):
            if len(image_from_bev) > 1:  # training clips: the device computes so many rays faster
                image_from_bev = upload(image_from_bev, device)
            rays = ray_features(image_from_bev.flatten(0, 1), level_shapes, image_size, self.height_m)
            scale, shift = self.layers(upload(rays, device)).chunk(2, dim=-1)
            return 1 + scale, shift


def ray_features(
    image_from_bev: Tensor, level_shapes: LevelShapes, image_size: tuple[int, int], height_m: float
) -> Tensor:
    """(K, S, RAY_FEATURES) float32: numbers of about 1 that describe the viewing rays of all cells of K images.

    image_from_bev: (K, 4, 4) float32. level_shapes: (rows, columns) of each feature map, S cells in all.
    image_size: (height, width), pixels. height_m: of the bev frame above the ground, metres.
    """
    matrix = image_from_bev[:, :3, :3].float()
    rows = matrix.unbind(1)
    # The inverse by cross products, which ONNX has.
    columns = [torch.linalg.cross(rows[i], rows[j]) for i, j in ((1, 2), (2, 0), (0, 1))]
    determinant = (rows[0] * columns[0]).sum(-1)
    bev_from_image = torch.stack(columns, dim=-1) / determinant[:, None, None]  # (K, 3, 3)
    center = -(bev_from_image * image_from_bev[:, None, :3, 3]).sum(-1)  # (K, 3)
    focal = torch.linalg.norm(columns[0], dim=-1).reciprocal() * determinant  # of the x axis, pixels
    levels = []
    for level_rows, level_columns in level_shapes:
        v = (torch.arange(level_rows, dtype=torch.float32, device=matrix.device) + 0.5) * (image_size[0] / level_rows)
        u = torch.arange(level_columns, dtype=torch.float32, device=matrix.device) + 0.5
        u = u * (image_size[1] / level_columns)
        vv, uu = torch.meshgrid(v, u, indexing="ij")
        pixels = torch.stack([uu, vv, torch.ones_like(uu)], dim=-1).flatten(0, 1)  # (S_l, 3), of the cells' centres
        rays = (bev_from_image[:, None] * pixels[:, None]).sum(-1)  # (K, S_l, 3), of depth 1 m
        above_ground = (center[:, None, 2] + height_m).clamp(min=0.1)
        to_ground = (-rays[..., 2] / above_ground).clamp(0.0, 1 / _NEAREST_M)[..., None]  # inverse depth of the ground
        directions = rays / torch.linalg.norm(rays, dim=-1, keepdim=True)
        cells = focal * level_columns / image_size[1]
        of_camera = torch.cat([center / _METRES, torch.log(cells / _FOCAL)[:, None]], dim=-1)[:, None]
        numbers = [directions, of_camera.expand(-1, len(pixels), -1), to_ground, torch.log1p(20 * to_ground)]
        levels.append(torch.cat(numbers, dim=-1))
    return torch.cat(levels, dim=1)
