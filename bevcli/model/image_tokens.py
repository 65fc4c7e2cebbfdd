"""Image features as tokens, with the embeddings of their camera and feature level."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from bevcli.model.deformable_attention import FeatureMaps


@dataclass(frozen=True)
class ImageTokensConfig:
    """The embeddings that are added to image features.

    Attributes:
        camera_embedding: whether every image feature gets the learned embedding of its camera.
        level_embeddings: number of learned level embeddings, at least the neck's levels (published weights hold four).
        calibration_embedding: whether every image feature gets an embedding of its viewing ray, see
            `CalibrationEmbedding`. The published models have none.
    """

    camera_embedding: bool = True
    level_embeddings: int = 4
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
