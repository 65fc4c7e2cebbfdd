"""ImageConfig: the pictures that a model takes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class ImageConfig:
    """How a picture becomes the network's input: normalised in float, resized, padded right and bottom.

    scale: factor on a picture's width and height; used where target_size is None.
    target_size: (width, height) in pixels that every picture is resized to.
    pad_divisor: width and height are padded with zeros to a multiple of it.
    mean, std: of a channel, on 0 to 255, in the order of color_order.
    """

    mean: tuple[float, float, float]
    std: tuple[float, float, float]
    color_order: Literal["rgb", "bgr"]
    scale: float = 1.0
    target_size: tuple[int, int] | None = None
    pad_divisor: int = 32

    def __post_init__(self) -> None:
        if self.scale <= 0 or min(self.std) <= 0 or self.pad_divisor < 1:
            raise ValueError("scale, std and pad_divisor must be positive")
        if self.target_size is not None and min(self.target_size) < 1:
            raise ValueError("target_size must be positive")
