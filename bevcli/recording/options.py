"""RecordingOptions: how much a recording holds, and which of the model's insides it shows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from bevcli.errors import InputError

Level = Literal["minimal", "standard", "full"]
LEVELS: tuple[Level, ...] = ("minimal", "standard", "full")


@dataclass(frozen=True)
class RecordingOptions:
    """What `bevcli run` writes into a recording.

    level: "minimal" images, boxes, ego and curves; "standard" adds the BEV map, the pillars and the history map;
    "full" thins nothing. bev: "norm", "pca", "channel:K" or "none", how BEV features become an image. score: boxes
    below it are not shown. probes: x, y in metres in the bev frame, the cells whose attention is drawn.
    live: a viewer shows the recording while it is written.

    Raises InputError for an unknown level or kind of BEV image.
    """

    level: Level = "standard"
    bev: str = "pca"
    score: float = 0.25
    probes: tuple[tuple[float, float], ...] = ()
    live: bool = False

    def __post_init__(self) -> None:
        if self.level not in LEVELS:
            raise InputError(f'--record: unknown level "{self.level}" (expected {", ".join(LEVELS)})')
        if self.bev not in ("norm", "pca", "none") and self.channel is None:
            raise InputError(f'--bev: unknown image "{self.bev}" (expected norm, pca, channel:K or none)')

    @property
    def channel(self) -> int | None:
        """K of "channel:K", else None."""
        kind, _, number = self.bev.partition(":")
        return int(number) if kind == "channel" and number.isdecimal() else None

    @property
    def shows_insides(self) -> bool:
        """Whether the BEV map, pillars and attention are written."""
        return self.level != "minimal"
