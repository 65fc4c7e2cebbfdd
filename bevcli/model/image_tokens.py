"""Image features as tokens, told which camera and which feature level they come from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from bevcli.model.deformable_attention import FeatureMaps


@dataclass(frozen=True)
class ImageTokensConfig:
    """camera_embedding: whether a learned vector of its camera is added to every image feature.

    level_embeddings: learned vectors of feature levels, at least as many as the neck has levels
    (the published files of weights always hold four).
    """

    camera_embedding: bool = True
    level_embeddings: int = 4


class ImageTokens(nn.Module):
    """Adds the camera embedding and the level embedding to the neck's maps and lays them out as tokens."""

    def __init__(self, cameras: int, channels: int, config: ImageTokensConfig) -> None:
        super().__init__()
        self.level_embedding = nn.Parameter(torch.randn(config.level_embeddings, channels))
        self.camera_embedding: nn.Parameter | None = None
        if config.camera_embedding:
            self.camera_embedding = nn.Parameter(torch.randn(cameras, channels))

    def forward(self, maps: Sequence[Tensor], camera_index: Tensor) -> FeatureMaps:
        """maps: (B·N, C, H_l, W_l), one a level. camera_index: (N,) int64.

        Returns the tokens (B·N, S, C) of B·N maps with L levels, in the maps' dtype: rounded once where that is half.
        """
        level_shapes = tuple((x.shape[-2], x.shape[-1]) for x in maps)
        levels = [x.flatten(2).transpose(1, 2) + self.level_embedding[i] for i, x in enumerate(maps)]
        tokens = torch.cat(levels, dim=1)  # (B·N, S, C)
        if self.camera_embedding is None:
            return FeatureMaps(tokens.to(maps[0].dtype), level_shapes)
        embedding = self.camera_embedding[camera_index]  # (N, C)
        by_camera = tokens.unflatten(0, (-1, len(camera_index))) + embedding[:, None]
        return FeatureMaps(by_camera.flatten(0, 1).to(maps[0].dtype), level_shapes)
