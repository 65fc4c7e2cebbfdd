"""The colours of classes, ground truth, misses and curves, and colour maps. Colours are RGB, 0 to 255."""

import colorsys
from collections.abc import Iterable, Mapping
from functools import cache
from itertools import cycle

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from bevcli.geometry.object_classes import Color, ObjectClass

GROUND_TRUTH_COLOR: Color = (235, 238, 245)
OTHER_COLOR: Color = (128, 132, 140)  # ground truth of a class that is not among the model's
MISSED_COLOR: Color = (255, 45, 85)
FALSE_COLOR: Color = (255, 45, 85)
EGO_COLOR: Color = (90, 200, 250)
STAGE_COLORS: tuple[Color, ...] = (
    (96, 165, 255), (255, 158, 44), (70, 222, 190), (240, 108, 190), (245, 222, 90), (178, 130, 255), (186, 222, 92),
)  # fmt: skip
DUPLICATE_COLOR: Color = (150, 156, 170)
RING_COLOR: Color = (92, 98, 112)
# Dark and hardly coloured, so that nothing on a map looks like a box. The views have a dark background in every theme.
MAP_COLORS: dict[str, Color] = {
    "drivable_road": (58, 64, 75),
    "lane_boundary": (112, 112, 100),
    "pedestrian_crossing": (86, 76, 104),
    "vehicle": (44, 84, 112),
    "drivable_area": (70, 78, 72),
    "divider": (125, 95, 55),
    "contour": (20, 125, 120),
}
# For classes that are not in MAP_COLORS.
OTHER_MAP_COLORS: tuple[Color, ...] = (
    (85, 45, 20), (90, 125, 80), (75, 40, 80), (65, 70, 20), (35, 55, 100), (125, 85, 80), (20, 80, 55), (90, 40, 55),
)  # fmt: skip
BACKGROUND: Color = (18, 20, 25)


def class_colors(classes: Iterable[ObjectClass]) -> dict[str, Color]:
    """The colours of a model's classes, in their order. A class without a colour takes one by its index."""
    return {object_class.name: object_class.color or index_color(index) for index, object_class in enumerate(classes)}


def index_color(index: int) -> Color:
    """A bright colour; neighbouring indices differ much."""
    red, green, blue = colorsys.hsv_to_rgb((0.11 + index * 0.618034) % 1.0, 0.65, 1.0)
    return round(red * 255), round(green * 255), round(blue * 255)


def map_colors(
    classes: Iterable[str], named: Mapping[str, Color] = MAP_COLORS, others: Iterable[Color] = OTHER_MAP_COLORS
) -> dict[str, Color]:
    """Map class -> colour, in the order of the classes. Classes that are not in `named` take `others` in turn."""
    rest = cycle(others)
    return {name: named[name] if name in named else next(rest) for name in classes}


def colormap(values: ArrayLike, name: str = "viridis") -> NDArray[np.uint8]:
    """Values 0 to 1 of any shape (...,) -> colours (..., 3) uint8 RGB. name: one of OpenCV's colour maps."""
    indices = np.clip(np.asarray(values, dtype=np.float64) * 255, 0, 255).astype(np.uint8)
    return _table(name).take(indices, axis=0)


@cache
def _table(name: str) -> NDArray[np.uint8]:
    """(256, 3) RGB, the colours of one of OpenCV's colour maps."""
    levels = np.arange(256, dtype=np.uint8)[:, None]
    colors = cv2.applyColorMap(levels, getattr(cv2, f"COLORMAP_{name.upper()}"))[:, 0, ::-1]
    return np.ascontiguousarray(colors, dtype=np.uint8)
