"""RecordingOptions: how much a recording holds, and how it is drawn."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from bevcli.errors import InputError
from bevcli.recording.video_images import require_av

Images = Literal["jpeg", "av1"]
Level = Literal["minimal", "standard", "full"]
LEVELS: tuple[Level, ...] = ("minimal", "standard", "full")


@dataclass(frozen=True)
class RecordingOptions:
    """What goes into a recording.

    Attributes:
        level: "minimal": images, boxes, ego pose, curves and events. "standard": also the BEV features, the
            segmentation, the history map, probes and pillars (at most 25 by 25). "full": all pillars of the grid.
        bev: how BEV features become an image: "norm", "pca", "channel:K" or "none".
        score: boxes with a lower score are not shown.
        probes: x, y in the bev frame, metres, of the cells whose attention is drawn.
        vehicle_mesh: a mesh file of the ego vehicle (`vehicle.load_vehicle` says which axes it must have);
            None draws the default car.
        images: "jpeg": the bytes of the image files, whatever their format; images of a video as JPEG. "av1": one AV1
            video stream for each camera, which is smaller and not lossless.

    Raises InputError for an unknown level, kind of BEV image or format of images, and for a mesh file that does not
    exist; BevcliError for "av1" without PyAV.
    """

    level: Level = "standard"
    bev: str = "pca"
    score: float = 0.25
    probes: tuple[tuple[float, float], ...] = ()
    vehicle_mesh: Path | None = None
    images: Images = "jpeg"

    def __post_init__(self) -> None:
        if self.level not in LEVELS:
            raise InputError(f'--record: unknown level "{self.level}" (expected {", ".join(LEVELS)})')
        if self.bev not in ("norm", "pca", "none") and self.channel is None:
            raise InputError(f'--bev: unknown image "{self.bev}" (expected norm, pca, channel:K or none)')
        if self.images not in ("jpeg", "av1"):
            raise InputError(f'--images: unknown format "{self.images}" (expected jpeg or av1)')
        if self.images == "av1":
            require_av("--images av1")
        if self.vehicle_mesh is not None and not self.vehicle_mesh.is_file():
            raise InputError(f"--vehicle-mesh {self.vehicle_mesh}: there is no such file")

    @property
    def channel(self) -> int | None:
        """K of "channel:K", else None."""
        kind, _, number = self.bev.partition(":")
        return int(number) if kind == "channel" and number.isdecimal() else None

    @property
    def shows_internals(self) -> bool:
        """Whether BEV features, segmentation, history, pillars and probes are written."""
        return self.level != "minimal"
