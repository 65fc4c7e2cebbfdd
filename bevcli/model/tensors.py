"""The tensors in nested tuples, lists and dataclasses."""

from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from typing import Any

from torch import Tensor


def tensors_in(value: object, name: str = "") -> Iterator[tuple[str, Tensor]]:
    """The tensors in lists and dataclasses, with the name of the field that holds them, `name` outside of one."""
    if isinstance(value, Tensor):
        yield name, value
    elif isinstance(value, tuple | list):
        for part in value:
            yield from tensors_in(part, name)
    elif is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            yield from tensors_in(getattr(value, field.name), field.name)


def exchanged(value: Any, others: Iterator[Any]) -> Any:
    """The value with others in the place of its tensors, in the order of `tensors_in`."""
    if isinstance(value, Tensor):
        return next(others)
    if isinstance(value, tuple | list):
        return type(value)(exchanged(part, others) for part in value)
    if is_dataclass(value) and not isinstance(value, type):
        return replace(value, **{part.name: exchanged(getattr(value, part.name), others) for part in fields(value)})
    return value
