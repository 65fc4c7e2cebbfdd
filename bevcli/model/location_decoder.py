"""The location decoder of the segmentation head: thing queries learn where their things are (Panoptic SegFormer)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from bevcli.model.decoder import DecoderConfig, DecoderLayer
from bevcli.model.detection_head import inverse_sigmoid


class LocationDecoder(nn.Module):
    """Queries refined on the BEV map, each with the centre and the scale of its thing.

    The locations serve training only: they make the queries aware of place before the masks are drawn.
    """

    def __init__(self, config: DecoderConfig, channels: int, bev_shape: tuple[int, int]) -> None:
        super().__init__()
        # Of each thing query the position half, then the content half.
        self.query_embedding = nn.Parameter(torch.randn(config.queries, 2 * channels))
        self.reference_points = nn.Linear(channels, 2)
        self.layers = nn.ModuleList(DecoderLayer(config, channels, bev_shape) for _ in range(config.layers))
        self.location_branches = nn.ModuleList(_location_branch(channels) for _ in range(config.layers))

    def forward(self, bev: Tensor) -> tuple[Tensor, Tensor]:
        """bev: (B, Y·X, C) -> thing queries (B, T, C) and locations (L, B, T, 4), one a layer.

        A location is the centre x, y and the extent along x and y, all 0 to 1 over the map.
        """
        position, query = self.query_embedding.expand(len(bev), -1, -1).chunk(2, dim=-1)  # (B, T, C) each
        reference_points = self.reference_points(position).sigmoid()  # (B, T, 2)
        locations = []
        for layer, branch in zip(self.layers, self.location_branches, strict=True):
            query = layer(query, position, reference_points, bev)
            moved, scale = branch(query).chunk(2, dim=-1)
            center = (moved + inverse_sigmoid(reference_points)).sigmoid()
            locations.append(torch.cat([center, scale.sigmoid()], dim=-1))
            reference_points = center.detach()
        return query, torch.stack(locations)


def _location_branch(channels: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(channels, channels), nn.ReLU(), nn.Linear(channels, 4))
