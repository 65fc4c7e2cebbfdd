"""Boxes whose columns are mostly alike."""

from typing import Any

import numpy as np

from bevcli.geometry.boxes import Boxes3D


def made_boxes(centers: Any, classes: Any = "car", **columns: Any) -> Boxes3D:
    """Boxes at centers (N, 3), or (N, 2) on the plane z = 0. A single value of a column stands for all boxes.

    They are 4 x 2 x 1.5 m large, head along x and stand, unless the columns say otherwise.
    """
    count = len(centers)
    places = np.array(centers, dtype=np.float64).reshape(count, -1 if count else 3)
    places = np.pad(places, ((0, 0), (0, 3 - places.shape[1])))
    given = {"sizes_lwh": (4.0, 2.0, 1.5), "yaws": 0.0, "velocities": (0.0, 0.0), "classes": classes} | columns
    lengths = {"sizes_lwh": (3,), "velocities": (2,)}
    made = {
        name: np.broadcast_to(np.asarray(value), (count, *lengths.get(name, ()))).copy()
        for name, value in given.items()
        if value is not None
    }
    return Boxes3D(places, **made)
