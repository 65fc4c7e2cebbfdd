"""Feature pyramid network (Lin et al. 2017): the neck."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch.nn.functional as F
from torch import Tensor, nn


@dataclass(frozen=True)
class FPNConfig:
    """The neck."""

    levels: int = 1  # number of output maps. Those beyond the backbone's maps come from stride-2 convolutions


class FPN(nn.Module):
    """Brings the backbone's maps to C channels and adds coarse context to the finer maps; no norm."""

    def __init__(self, in_channels: Sequence[int], channels: int, config: FPNConfig) -> None:
        super().__init__()
        extra = config.levels - len(in_channels)
        self.lateral = nn.ModuleList(nn.Conv2d(c, channels, 1) for c in in_channels)
        self.output = nn.ModuleList(nn.Conv2d(channels, channels, 3, padding=1) for _ in in_channels)
        self.extra = nn.ModuleList(nn.Conv2d(channels, channels, 3, stride=2, padding=1) for _ in range(extra))
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.xavier_uniform_(module.weight)
                nn.init.zeros_(module.bias)  # type: ignore[arg-type]

    def forward(self, maps: Sequence[Tensor]) -> list[Tensor]:
        """maps: (B, C_i, H_i, W_i), fine to coarse -> `levels` maps (B, C, H_i, W_i), fine to coarse.

        A detector has more maps than it takes: the coarsest are for its own boxes.
        """
        merged = [lateral(x) for lateral, x in zip(self.lateral, maps, strict=False)]
        for i in range(len(merged) - 1, 0, -1):
            merged[i - 1] = merged[i - 1] + F.interpolate(merged[i], size=merged[i - 1].shape[-2:], mode="nearest")
        outputs = [output(x) for output, x in zip(self.output, merged, strict=True)]
        for i, convolution in enumerate(self.extra):
            # As in the released code, a ReLU stands before every extra level but the first.
            outputs.append(convolution(F.relu(outputs[-1]) if i else outputs[-1]))
        return outputs
