"""The tensors in nested tuples, lists and dataclasses; and where they are computed in float32."""

from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import fields, is_dataclass, replace
from functools import cache
from typing import Any

import torch
from torch import Tensor


def without_autocast(device: torch.device) -> AbstractContextManager[object]:
    """Inside, nothing is cast to half precision: it is too coarse for the refinement of boxes."""
    return nullcontext() if device.type == "meta" else torch.autocast(device.type, enabled=False)


def tensors_in(value: object, name: str = "") -> Iterator[tuple[str, Tensor]]:
    """The tensors in lists and dataclasses, with the name of the field that holds them, `name` outside of one."""
    if isinstance(value, Tensor):
        yield name, value
    elif isinstance(value, tuple | list):
        for part in value:
            yield from tensors_in(part, name)
    else:
        for field in _field_names(value):
            yield from tensors_in(getattr(value, field), field)


def exchanged(value: Any, others: Iterator[Any]) -> Any:
    """The value with others in the place of its tensors, in the order of `tensors_in`."""
    if isinstance(value, Tensor):
        return next(others)
    if isinstance(value, tuple | list):
        return type(value)(exchanged(part, others) for part in value)
    names = _field_names(value)
    return replace(value, **{name: exchanged(getattr(value, name), others) for name in names}) if names else value


def _field_names(value: object) -> tuple[str, ...]:
    """Of a dataclass; () for another value. They are kept: asking a dataclass takes longer than copying a tensor."""
    kind: Any = type(value)
    return _fields_of(kind)


@cache
def _fields_of(kind: Any) -> tuple[str, ...]:
    return tuple(field.name for field in fields(kind)) if is_dataclass(kind) else ()
