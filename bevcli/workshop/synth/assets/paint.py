"""Colours: in sRGB where they are chosen, in linear RGB where light is computed."""

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Color = tuple[int, int, int]  # sRGB, 0 to 255


class Material(IntEnum):
    """Kind of shading of a face. PAINT and DYE faces take the two colours of the individual."""

    MATTE = 0
    PAINT = 1
    GLASS = 2
    GLOW = 3
    GROUND = 4
    FACADE = 5
    DYE = 6
    LEAVES = 7


class Finish(NamedTuple):
    """The colour and the material of a surface.

    Attributes:
        color: sRGB. That of PAINT and DYE is a placeholder.
        material: kind of shading.
    """

    color: Color
    material: Material = Material.MATTE


Surface = Color | Finish  # a colour alone is matte

# Parts of vehicles.
PAINT = Finish((200, 200, 200), Material.PAINT)
DYED_PAINT = Finish((200, 200, 200), Material.DYE)
CARGO = Finish((224, 224, 220), Material.DYE)
GLASS = Finish((38, 48, 56), Material.GLASS)
TRIM: Color = (34, 35, 38)
HEADLAMP = Finish((255, 248, 226), Material.GLOW)
TAIL_LAMP = Finish((190, 16, 18), Material.GLOW)

# Colours to draw from.
CAR_PAINTS: tuple[Color, ...] = (
    (235, 236, 238), (196, 199, 203), (120, 124, 130), (62, 66, 72), (26, 28, 32), (170, 28, 30), (120, 22, 30),
    (28, 60, 128), (52, 108, 176), (22, 40, 70), (34, 84, 62), (214, 178, 40), (204, 98, 32), (150, 132, 104),
    (108, 80, 58), (92, 132, 142),
)  # fmt: skip
TRUCK_PAINTS: tuple[Color, ...] = (
    (238, 238, 236), (228, 228, 224), (196, 40, 34), (30, 84, 160), (226, 168, 30), (44, 112, 72), (104, 108, 112),
    (232, 120, 36),
)  # fmt: skip
BUS_PAINTS: tuple[Color, ...] = (
    (224, 60, 44), (36, 98, 176), (240, 190, 40), (240, 240, 236), (48, 140, 92), (128, 52, 120), (52, 168, 178),
)  # fmt: skip
MACHINE_PAINTS: tuple[Color, ...] = ((236, 176, 24), (232, 140, 20), (222, 92, 28), (236, 200, 60), (188, 190, 60))
CLOTHES: tuple[Color, ...] = (
    (40, 42, 48), (70, 76, 88), (132, 136, 142), (204, 202, 196), (150, 40, 44), (40, 70, 130), (78, 112, 160),
    (58, 96, 70), (188, 148, 60), (120, 72, 110), (196, 112, 92), (96, 76, 60),
)  # fmt: skip


def linear(color: ArrayLike) -> NDArray[np.float32]:
    """Convert sRGB (..., 3), 0 to 255, to linear RGB (..., 3), 0 to 1."""
    c = np.asarray(color, dtype=np.float64) / 255
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4).astype(np.float32)


def darker(color: Color, factor: float) -> Color:
    """The colour with each component multiplied by a factor."""
    red, green, blue = (int(component * factor) for component in color)
    return red, green, blue
