"""Metrics of a planned path: distance to the driven one, and collisions, in the two conventions of published tables.

ST-P3 and VAD state the mean up to a horizon, UniAD the value at the horizon. Numbers of the first are much smaller for
the same path. UniAD looks at vehicles only, the others also at pedestrians.

Both turn neither the vehicle nor its footprint, and both count no collision in a step where the driven path has one.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array

CELL_M = 0.5
CELLS = 200
# Cells of the vehicle, 4.084 x 1.85 m and 0.5 m ahead of the lidar, counted from the corner of the map.
AHEAD, ACROSS = np.arange(97, 105), np.arange(98, 102)
NO_AGENTS = ("barrier", "traffic_cone")
HUMANS = ("pedestrian",)


@dataclass(frozen=True)
class PlannedFrame:
    """One frame with its whole future.

    All places are in metres, x to the right and y ahead of the vehicle at the frame's time.

    Attributes:
        path: (T, 2) planned places.
        driven: (T, 2) places where the vehicle was.
        others: T sets of boxes, the true objects at each step.
    """

    path: Array
    driven: Array
    others: Sequence[Boxes3D]


@dataclass(frozen=True)
class PlanScores:
    """The scores of S planned paths of T steps, S > 0.

    Attributes:
        distances_m: (S, T), planned to driven.
        collisions: (S, T), with vehicles and pedestrians.
        collisions_with_vehicles: (S, T).
        step_s: seconds of a step.
    """

    distances_m: Array
    collisions: NDArray[np.bool_]
    collisions_with_vehicles: NDArray[np.bool_]
    step_s: float

    def averaged(self, values: NDArray[np.generic], seconds: float) -> float:
        """The mean over all steps up to a horizon, as ST-P3 and VAD state it. values: an attribute."""
        return float(values[:, : self._steps(seconds)].mean())

    def at(self, values: NDArray[np.generic], seconds: float) -> float:
        """The mean of the step at a horizon, as UniAD states it. values: an attribute."""
        return float(values[:, self._steps(seconds) - 1].mean())

    def _steps(self, seconds: float) -> int:
        return round(seconds / self.step_s)


def evaluate_plans(frames: Iterable[PlannedFrame], step_s: float) -> PlanScores:
    """Score planned paths, at least one, of steps of so many seconds."""
    distances, hits, with_vehicles = map(np.array, zip(*map(_score, frames), strict=True))
    return PlanScores(distances, hits, with_vehicles, step_s)


def _score(frame: PlannedFrame) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]:
    agents = [boxes[~np.isin(boxes.classes, NO_AGENTS)] for boxes in frame.others]
    vehicles = [boxes[~np.isin(boxes.classes, HUMANS)] for boxes in agents]
    distances = np.linalg.norm(frame.path - frame.driven, axis=-1)
    hits = (collisions(frame.path, frame.driven, occupancy(boxes)) for boxes in (agents, vehicles))
    return (distances, *hits)


def occupancy(others: Sequence[Boxes3D]) -> NDArray[np.bool_]:
    """(T, CELLS, CELLS) cells that boxes cover in each step; row 0 is 50 m ahead, column 0 is 50 m to the left."""
    covered = np.zeros((len(others), CELLS, CELLS), np.uint8)
    for image, boxes in zip(covered, others, strict=True):
        corners = boxes.corners()[:, :4, :2]
        pixels = np.rint((corners * (1, -1) + CELLS * CELL_M / 2) / CELL_M).astype(np.int32)
        for rectangle in pixels:
            cv2.fillPoly(image, [rectangle], 1)
    return covered.astype(bool)


def collisions(path: Array, driven: Array, covered: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(T,) whether the planned vehicle covers an occupied cell where the driven one does not.

    path, driven: (T, 2). covered: of `occupancy`.
    """
    return hits(path, covered) & ~hits(driven, covered)


def hits(path: Array, covered: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(T,) whether the vehicle, at the places of a path (T, 2) and not turned, covers an occupied cell."""
    row = np.clip(np.trunc(CELLS - (path[:, 1:] / CELL_M + AHEAD)).astype(int), 0, CELLS - 1)  # (T, 8)
    column = np.clip(np.trunc(path[:, :1] / CELL_M + ACROSS).astype(int), 0, CELLS - 1)  # (T, 4)
    step = np.arange(len(path))[:, None, None]
    return covered[step, row[:, :, None], column[:, None]].any((1, 2))
