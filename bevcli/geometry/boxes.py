"""Boxes3D: oriented boxes in one frame, with what is known of each."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bevcli.geometry.transforms import Array, apply

# The ten detection classes of nuScenes, in the order of the published models' class scores.
CLASSES = (
    "car", "truck", "construction_vehicle", "bus", "trailer",
    "barrier", "motorcycle", "bicycle", "pedestrian", "traffic_cone",
)  # fmt: skip


@dataclass(frozen=True)
class Boxes3D:
    """N boxes in one frame of reference (bev, ego or world; which one is said by whoever holds them).

    centers: (N, 3) box middles, metres. sizes_lwh: (N, 3) length, width, height, metres.
    yaws: (N,) radians, counter-clockwise about z, 0 along x. velocities: (N, 2) m/s along x and y, NaN unknown.
    classes: (N,) names. Optional, None where unknown for all: scores (N,) 0 to 1; attributes (N,) nuScenes
    names, "" for none; instances (N,) identities over time, "" for none; track_scores (N,) 0 to 1, of the track that a
    box belongs to, NaN without one; duplicates (N,) bool, whether a better box lies on the same object;
    visibilities (N,) 0 to 1, NaN unknown;
    num_points (N,) int, 0: not to be scored, -1 unknown.
    """

    centers: Array
    sizes_lwh: Array
    yaws: Array
    velocities: Array
    classes: NDArray[np.str_]
    scores: Array | None = None
    attributes: NDArray[np.str_] | None = None
    instances: NDArray[np.str_] | None = None
    track_scores: Array | None = None
    duplicates: NDArray[np.bool_] | None = None
    visibilities: Array | None = None
    num_points: NDArray[np.int64] | None = None

    def __len__(self) -> int:
        return len(self.centers)

    def __getitem__(self, selection: ArrayLike | slice) -> Boxes3D:
        """The boxes of a mask (N,) bool, an index array or a slice."""
        key = selection if isinstance(selection, slice) else np.asarray(selection)
        return self._map(lambda column: column[key])

    @staticmethod
    def empty() -> Boxes3D:
        """No box at all."""
        return Boxes3D(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros((0, 2)), np.zeros(0, "<U1"))

    @staticmethod
    def concatenate(parts: Iterable[Boxes3D]) -> Boxes3D:
        """All boxes of the parts; a column stays where every part that has boxes has it."""
        filled = [part for part in parts if len(part)]
        if not filled:
            return Boxes3D.empty()
        columns: dict[str, Any] = {}
        for field in fields(Boxes3D):
            values = [getattr(part, field.name) for part in filled]
            columns[field.name] = None if any(v is None for v in values) else np.concatenate(values)
        return Boxes3D(**columns)

    def transformed(self, a_from_b: ArrayLike) -> Boxes3D:
        """The boxes, given in b, in a. Yaw and velocity turn with the rotation; boxes stay upright."""
        matrix = np.asarray(a_from_b, dtype=np.float64)
        headings = np.stack([np.cos(self.yaws), np.sin(self.yaws), np.zeros(len(self))], axis=-1)
        turned = headings @ matrix[:3, :3].T
        velocities = np.concatenate([self.velocities, np.zeros((len(self), 1))], axis=-1) @ matrix[:3, :3].T
        return replace(
            self,
            centers=apply(matrix, self.centers),
            yaws=np.arctan2(turned[:, 1], turned[:, 0]),
            velocities=velocities[:, :2],
        )

    def corners(self) -> Array:
        """(N, 8, 3): bottom four counter-clockwise from front left, then the top four in the same order."""
        half = self.sizes_lwh[:, None, :] / 2
        signs = np.array(
            [
                [1, 1, -1],
                [-1, 1, -1],
                [-1, -1, -1],
                [1, -1, -1],
                [1, 1, 1],
                [-1, 1, 1],
                [-1, -1, 1],
                [1, -1, 1],
            ]
        )
        local = half * signs
        c, s = np.cos(self.yaws)[:, None], np.sin(self.yaws)[:, None]
        x = c * local[..., 0] - s * local[..., 1]
        y = s * local[..., 0] + c * local[..., 1]
        return np.stack([x, y, local[..., 2]], axis=-1) + self.centers[:, None, :]

    def _map(self, change: Callable[[NDArray], NDArray]) -> Boxes3D:
        columns = {f.name: getattr(self, f.name) for f in fields(self)}
        changed: dict[str, Any] = {name: None if c is None else change(c) for name, c in columns.items()}
        return replace(self, **changed)


# The twelve edges of `Boxes3D.corners`, as pairs of corner indices.
BOX_EDGES = (
    (0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7),
)  # fmt: skip
