"""Copies from the CPU to a device that the CPU does not wait for, and tables that are copied only once."""

from collections.abc import Sequence

import torch
from torch import Tensor

from bevcli.model.deformable_attention import LevelShapes


def upload(tensor: Tensor, device: torch.device) -> Tensor:
    """The tensor on a device; itself where it is there already.

    A CUDA GPU copies from pinned memory when it gets there, while the CPU goes on. Without pinned memory the CPU would
    wait for the GPU.
    """
    if device.type == "cuda" and tensor.device.type == "cpu":
        return pinned(tensor).to(device, non_blocking=True)
    return tensor.to(device)


def pinned(tensor: Tensor) -> Tensor:
    """A copy of a CPU tensor in memory that a GPU reads by itself. Needs a CUDA GPU."""
    return tensor.pin_memory()


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
