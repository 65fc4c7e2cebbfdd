"""Boxes in one image, with class and score."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.transforms import Array


@dataclass(frozen=True)
class Box2D:
    """One of `Boxes2D`.

    Attributes:
        class_name: such as "person".
        score: confidence, 0 to 1.
        corners: (4,) x0, y0, x1, y1, pixels.
    """

    class_name: str
    score: float
    corners: Array

    def __repr__(self) -> str:
        x0, y0, x1, y1 = self.corners
        return f"Box2D({self.class_name} {self.score:.2f} at {x0:.0f}, {y0:.0f}, {x1:.0f}, {y1:.0f})"


@dataclass(frozen=True)
class Boxes2D:
    """N boxes in an image, by falling score. They are a sequence of `Box2D`.

    Attributes:
        corners: (N, 4) x0, y0, x1, y1, pixels of the camera's image, whose first pixel has its centre at (0, 0): a box
            of the whole image is (-0.5, -0.5, width - 0.5, height - 0.5).
        classes: (N,) names of COCO: person, bicycle, car, motorcycle, bus, truck, traffic light.
        scores: (N,) confidence, 0 to 1.
    """

    corners: Array
    classes: NDArray[np.str_]
    scores: Array

    def __len__(self) -> int:
        return len(self.scores)

    def __iter__(self) -> Iterator[Box2D]:
        for class_name, score, corners in zip(self.classes, self.scores, self.corners, strict=True):
            yield Box2D(str(class_name), float(score), corners)

    def select(self, chosen: NDArray[Any] | np.bool) -> "Boxes2D":
        """Some of the boxes. chosen: a mask (N,) bool, or indices."""
        return Boxes2D(self.corners[chosen], self.classes[chosen], self.scores[chosen])
