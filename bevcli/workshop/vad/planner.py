"""The planner of VAD: a query for the own vehicle attends to the objects and to the lines; the paths come of that."""

import torch
from torch import Tensor, nn

from bevcli.model.decoder import branch
from bevcli.workshop.vad.motion_head import MapTokens, MotionConfig


class Planner(nn.Module):
    """One path for each command. Nothing else of the vehicle enters: its speed is in the BEV map only."""

    def __init__(self, config: MotionConfig, commands: int, channels: int) -> None:
        super().__init__()
        self.shape = (commands, config.steps, 2)
        self.ego_query = nn.Parameter(torch.randn(1, channels))
        self.agent_attention = config.attention(channels)
        self.agent_position = nn.Linear(2, channels)
        self.line_attention = config.attention(channels)
        self.line_position = nn.Linear(2, channels)
        self.path_branch = branch(2 * channels, 3, commands * config.steps * 2)

    def forward(self, features: Tensor, positions: Tensor, lines: MapTokens) -> Tensor:
        """Movement (B, commands, T, 2) in each step along x and y of the bev frame, metres.

        Args:
            features: (B, Q, C) of the objects, `MotionOutputs.features`.
            positions: (B, Q, 2) their centres, 0 to 1 over the range.
            lines: all are attended to, whatever their scores.
        """
        corner = positions.new_zeros(1, 1, 2)  # the released code places the vehicle there, not in the middle
        ego = self.ego_query.expand(len(features), -1, -1)  # (B, 1, C)
        with_agents = self.agent_attention(ego, self.agent_position(corner), features, self.agent_position(positions))
        with_lines = self.line_attention(
            with_agents, self.line_position(corner), lines.features, self.line_position(lines.positions)
        )
        return self.path_branch(torch.cat([with_agents, with_lines], dim=-1)[:, 0]).unflatten(-1, self.shape)
