"""Copies from the CPU to a device that the CPU does not wait for."""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor

from bevcli.model.tensors import exchanged, tensors_in

Value = TypeVar("Value")
Method = TypeVar("Method", bound=Callable[..., Any])


def on_device(method: Method) -> Method:
    """Marks a method of a model that is a pure function of tensors on the device.

    It does not wait for the device, uploads nothing but its arguments, and no shape depends on a tensor's numbers. On a
    CUDA GPU it becomes a CUDA graph (`bevcli.model.prepare`).
    """
    vars(method)["is_on_device"] = True
    return method


def upload(tensor: Tensor, device: torch.device) -> Tensor:
    """The tensor on a device; itself where it is there already.

    A CUDA GPU copies from pinned memory when it gets there, while the CPU goes on. Without pinned memory the CPU would
    wait for the GPU.
    """
    if device.type == "cuda" and tensor.device.type == "cpu":
        return pinned(tensor).to(device, non_blocking=True)
    return tensor.to(device)


def upload_together(value: Value, device: torch.device) -> Value:
    """A nested tuple or dataclass with its tensors on a device. Those on the CPU go to a CUDA GPU in one copy."""
    tensors = [tensor for _, tensor in tensors_in(value)]
    missing = [tensor for tensor in tensors if tensor.device.type != device.type]
    if not missing:
        return value
    if device.type == "cuda":
        moved = iter(unpacked(upload(packed(missing), device), missing))
    else:
        moved = iter([tensor.to(device) for tensor in missing])
    found: Value = exchanged(value, (x if x.device.type == device.type else next(moved) for x in tensors))
    return found


def packed(tensors: Sequence[Tensor]) -> Tensor:
    """The bytes of tensors of one device, which one copy moves."""
    return torch.cat([tensors[place].reshape(-1).view(torch.uint8) for place in _order(tensors)])


def unpacked(memory: Tensor, like: Sequence[Tensor]) -> list[Tensor]:
    """The tensors in the bytes of `packed`, with the shapes and types of those that were packed."""
    order = _order(like)
    parts = memory.split([like[place].nbytes for place in order])
    found = {
        place: part.view(like[place].dtype).view(like[place].shape) for place, part in zip(order, parts, strict=True)
    }
    return [found[place] for place in range(len(like))]


def _order(tensors: Sequence[Tensor]) -> list[int]:
    """Those with the longest numbers first, so that each number lies at a multiple of its length."""
    return sorted(range(len(tensors)), key=lambda place: -tensors[place].itemsize)


def pinned(tensor: Tensor) -> Tensor:
    """A copy of a CPU tensor in memory that a GPU reads by itself. Needs a CUDA GPU."""
    return tensor.pin_memory()
