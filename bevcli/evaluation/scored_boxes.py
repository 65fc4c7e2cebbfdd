"""The boxes of many frames as one array."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array

# Value of an optional column in frames that do not have it.
_UNKNOWN = {
    "scores": np.float64(np.nan),
    "attributes": np.str_(""),
    "instances": np.str_(""),
    "track_scores": np.float64(np.nan),
    "duplicates": np.bool_(False),
    "visibilities": np.float64(np.nan),
    "num_points": np.int64(-1),
}


@dataclass(frozen=True)
class ScoredBoxes:
    """N boxes of many frames.

    Attributes:
        boxes: with all optional columns.
        frames: (N,), index of each box's frame.
        ranges_m: (N,), distance from the ego vehicle on the ground, metres.
    """

    boxes: Boxes3D
    frames: NDArray[np.int64]
    ranges_m: Array

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, selection: NDArray[Any]) -> ScoredBoxes:
        """The boxes selected by a mask (N,) bool or by indices."""
        return ScoredBoxes(self.boxes[selection], self.frames[selection], self.ranges_m[selection])


def gather(frames: Sequence[Boxes3D], ego_xy: Array) -> ScoredBoxes:
    """The boxes of F frames as one array.

    ego_xy: (F, 2), the ego vehicle's position in the frame of reference of each frame's boxes, metres.
    """
    indices = np.repeat(np.arange(len(frames)), [len(boxes) for boxes in frames])
    filled = [boxes for boxes in frames if len(boxes)] or [Boxes3D.empty()]
    columns: dict[str, Any] = {
        column.name: np.concatenate([_column(boxes, column.name) for boxes in filled]) for column in fields(Boxes3D)
    }
    boxes = Boxes3D(**columns)
    ranges = np.linalg.norm(boxes.centers[:, :2] - ego_xy[indices], axis=1)
    return ScoredBoxes(boxes, indices, ranges)


def _column(boxes: Boxes3D, name: str) -> NDArray[Any]:
    values = getattr(boxes, name)
    return np.full(len(boxes), _UNKNOWN[name]) if values is None else values
