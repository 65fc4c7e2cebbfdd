"""What a box is doing, by nuScenes' attribute names, guessed from its speed as the original BEVFormer does."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.boxes import Boxes3D

MOVING_MPS = 0.2
# Faster than MOVING_MPS, and else. A slow bus is "stopped" and not "parked": the original's rule.
_MOVING_AND_STILL = {
    "car": ("vehicle.moving", "vehicle.parked"),
    "truck": ("vehicle.moving", "vehicle.parked"),
    "construction_vehicle": ("vehicle.moving", "vehicle.parked"),
    "bus": ("vehicle.moving", "vehicle.stopped"),
    "trailer": ("vehicle.moving", "vehicle.parked"),
    "barrier": ("", ""),
    "motorcycle": ("cycle.with_rider", "cycle.without_rider"),
    "bicycle": ("cycle.with_rider", "cycle.without_rider"),
    "pedestrian": ("pedestrian.moving", "pedestrian.standing"),
    "traffic_cone": ("", ""),
}


def attributes_by_speed(boxes: Boxes3D) -> NDArray[np.str_]:
    """(N,) attribute names, "" for classes that have none; an unknown velocity counts as standing still."""
    moving = np.linalg.norm(boxes.velocities, axis=1) > MOVING_MPS
    names = [_MOVING_AND_STILL[str(name)][0 if fast else 1] for name, fast in zip(boxes.classes, moving, strict=True)]
    return np.array(names, dtype=np.str_)
