"""Feature pyramid network (Lin et al. 2017): the neck."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class FPNConfig:
    """levels: maps that the neck puts out. Those beyond the backbone's come from stride-2 convolutions."""

    levels: int = 1
