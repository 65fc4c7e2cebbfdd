"""Tables of numbers that the CPU knows, such as the sizes of feature levels: uploaded to a device once, then reused."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from bevcli.model.deformable_attention import LevelShapes
from bevcli.model.upload import upload

KEPT = 32  # tables; those of the sampling of all layers of a model, and of some frames' hits


class Tables:
    """Tables on devices. The layers of a model share one, so that equal tables are uploaded once."""

    def __init__(self) -> None:
        self._made: dict[tuple[object, ...], Tensor] = {}

    def __call__(self, rows: Sequence[object], dtype: torch.dtype, device: torch.device) -> Tensor:
        """`torch.tensor(rows)` on a device. rows: numbers, or tuples of numbers."""
        key = (tuple(rows), dtype, device)
        if key not in self._made:
            while len(self._made) >= KEPT:
                self._made.pop(next(iter(self._made)))
            self._made[key] = upload(torch.tensor(rows, dtype=dtype), device)
        return self._made[key]

    def level_sizes(self, level_shapes: LevelShapes, device: torch.device) -> Tensor:
        """As `bevcli.model.deformable_attention.level_sizes`."""
        return self([(width, height) for height, width in level_shapes], torch.float32, device)
