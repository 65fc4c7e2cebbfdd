"""Boxes whose columns are mostly alike, and random boxes to score with predictions near them."""

from dataclasses import replace
from typing import Any

import numpy as np

from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.object_classes import NUSCENES_CLASSES


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


def random_truth(seed: int, frames: int = 6, per_class: int = 3) -> list[Boxes3D]:
    """Frames with boxes of every class, within 28 m of the origin, everything about them known."""
    rng = np.random.default_rng(seed)
    count = per_class * len(NUSCENES_CLASSES)
    return [
        Boxes3D(
            centers=np.concatenate([rng.uniform(-19, 19, (count, 2)), rng.normal(0, 0.5, (count, 1))], axis=1),
            sizes_lwh=rng.uniform(0.5, 5, (count, 3)),
            yaws=rng.uniform(-3, 3, count),
            velocities=rng.normal(0, 3, (count, 2)),
            classes=np.repeat(tuple(NUSCENES_CLASSES), per_class),
            attributes=np.repeat(["vehicle.moving"], count),
            visibilities=rng.uniform(0, 1, count),
            num_points=rng.integers(1, 50, count),
        )
        for _ in range(frames)
    ]


def as_predictions(truth: list[Boxes3D], seed: int, noise_m: float = 0.0, false_per_frame: int = 0) -> list[Boxes3D]:
    """The truth with scores, moved by noise, with false positives."""
    rng = np.random.default_rng(seed)
    predictions = []
    for boxes in truth:
        moved = replace(
            boxes,
            centers=boxes.centers + rng.normal(0, noise_m, boxes.centers.shape),
            yaws=boxes.yaws + rng.normal(0, noise_m, len(boxes)),
            velocities=boxes.velocities + rng.normal(0, noise_m, boxes.velocities.shape),
        )
        invented = boxes[rng.integers(0, len(boxes), false_per_frame)]
        invented = replace(invented, centers=rng.uniform(-19, 19, invented.centers.shape))
        both = Boxes3D.concatenate([moved, invented])
        predictions.append(replace(both, scores=rng.uniform(0.1, 1, len(both)), visibilities=None, num_points=None))
    return predictions
