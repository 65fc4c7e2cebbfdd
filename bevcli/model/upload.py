"""Copies from the CPU to a device that the CPU does not wait for; the tensors in nested tuples and dataclasses."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import fields, is_dataclass, replace
from functools import cache
from typing import Any, TypeVar

import torch
from torch import Tensor

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
    uploaded: Value = exchanged(value, (x if x.device.type == device.type else next(moved) for x in tensors))
    return uploaded


def packed(tensors: Sequence[Tensor]) -> Tensor:
    """The bytes of tensors of one device, which one copy moves."""
    return torch.cat([tensors[index].reshape(-1).view(torch.uint8) for index in _order(tensors)])


def unpacked(memory: Tensor, like: Sequence[Tensor]) -> list[Tensor]:
    """The tensors in the bytes of `packed`, with the shapes and types of those that were packed."""
    order = _order(like)
    parts = memory.split([like[index].nbytes for index in order])
    by_index = {
        index: chunk.view(like[index].dtype).view(like[index].shape) for index, chunk in zip(order, parts, strict=True)
    }
    return [by_index[index] for index in range(len(like))]


def _order(tensors: Sequence[Tensor]) -> list[int]:
    """Those with the longest numbers first, so that each number lies at a multiple of its length."""
    return sorted(range(len(tensors)), key=lambda index: -tensors[index].itemsize)


def pinned(tensor: Tensor) -> Tensor:
    """A copy of a CPU tensor in memory that a GPU reads by itself. Needs a CUDA GPU."""
    return tensor.pin_memory()


def without_autocast(device: torch.device) -> AbstractContextManager[object]:
    """Inside, nothing is cast to half precision: it is too coarse for the refinement of boxes."""
    return nullcontext() if device.type == "meta" else torch.autocast(device.type, enabled=False)


def tensors_in(value: object, name: str = "") -> Iterator[tuple[str, Tensor]]:
    """The tensors in lists and dataclasses, with the name of the field that holds them, `name` outside of one."""
    if isinstance(value, Tensor):
        yield name, value
    elif isinstance(value, tuple | list):
        for item in value:
            yield from tensors_in(item, name)
    else:
        cls: Any = type(value)
        for field in _fields_of(cls):
            yield from tensors_in(getattr(value, field), field)


def exchanged(value: Any, others: Iterator[Any]) -> Any:
    """The value with others in the place of its tensors, in the order of `tensors_in`."""
    if isinstance(value, Tensor):
        return next(others)
    if isinstance(value, tuple | list):
        return type(value)(exchanged(item, others) for item in value)
    cls: Any = type(value)
    names = _fields_of(cls)
    return replace(value, **{name: exchanged(getattr(value, name), others) for name in names}) if names else value


@cache
def _fields_of(cls: Any) -> tuple[str, ...]:
    """Of a dataclass; () for another type. They are kept: asking a dataclass takes longer than copying a tensor."""
    return tuple(field.name for field in fields(cls)) if is_dataclass(cls) else ()
