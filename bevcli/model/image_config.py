"""ImageConfig: the images that a model takes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class ImageConfig:
    """How an image becomes the network's input: resized to fit, normalised in float, padded right and bottom.

    size: (width, height) in pixels, before padding. An image of another aspect is scaled to fit inside it.
    pad_divisor: width and height are padded with zeros to a multiple of it.
    mean, std: of a channel, on 0 to 255, in the order of color_order.
    resize: "linear", as the published weights know it, jagged where images shrink to less than half; "area" averages
    what falls into a pixel.
    """

    size: tuple[int, int]
    mean: tuple[float, float, float]
    std: tuple[float, float, float]
    color_order: Literal["rgb", "bgr"]
    pad_divisor: int = 32
    resize: Literal["linear", "area"] = "linear"

    def __post_init__(self) -> None:
        if min(self.size) < 1 or min(self.std) <= 0 or self.pad_divisor < 1:
            raise ValueError("size, std and pad_divisor must be positive")

    @property
    def padded_size(self) -> tuple[int, int]:
        """(width, height) of the network's input."""
        width, height = (-(-extent // self.pad_divisor) * self.pad_divisor for extent in self.size)
        return width, height
