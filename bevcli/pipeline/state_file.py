"""State files: trees of dataclasses, tensors, arrays and plain values in a .safetensors file.

A node of the tree is one of: None, bool, int, float, str; a tuple, list or dict of nodes; a torch tensor; a numpy array
of numbers, booleans or strings; an instance of a dataclass of this package. Reading runs no code: it imports
nothing, and fills in the fields of the dataclasses without calling them.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import save
from torch import Tensor

from bevcli.errors import InputError, OutputError
from bevcli.parsing.documents import parse_json
from bevcli.parsing.safetensors_file import read_safetensors

FORMAT = "bevcli-state/1"


def save_state(path: Path, tree: object) -> None:
    """Writes a state. The file is replaced at once, so that it is whole at every moment. Raises OutputError."""
    tensors: dict[str, Tensor] = {}
    node = _to_json(tree, tensors)
    text = json.dumps(node)
    content = save(tensors, {"format": FORMAT, "tree": text, "sha256": _hash(text, tensors)})
    fresh = path.with_name(path.name + ".new")
    try:
        fresh.write_bytes(content)
        os.replace(fresh, path)
    except OSError as error:
        with contextlib.suppress(OSError):
            fresh.unlink()
        raise OutputError(f"{path}: cannot be written ({error.strerror})") from None


def load_state(path: Path) -> Any:
    """Reads a state that `save_state` wrote; tensors are on the CPU. Raises InputError, also for a changed file."""
    tensors, metadata = read_safetensors(path)
    if metadata.get("format") != FORMAT:
        raise InputError(f'{path}: is not a state file: "format" must be "{FORMAT}"')
    text = metadata.get("tree", "")
    if metadata.get("sha256") != _hash(text, tensors):
        raise InputError(f"{path}: the state cannot be read: the file is damaged")
    try:
        return _from_json(parse_json(text.encode(), path), tensors)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: the state cannot be read ({error})") from None


def digest(tree: object) -> str:
    """A hash of a tree that `save_state` could write."""
    tensors: dict[str, Tensor] = {}
    node = _to_json(tree, tensors)
    return _hash(json.dumps(node), tensors)


def _hash(text: str, tensors: dict[str, Tensor]) -> str:
    """SHA-256 of a tree's text and tensors."""
    found = hashlib.sha256(text.encode())
    for name in sorted(tensors, key=lambda name: (len(name), name)):
        tensor = tensors[name]
        found.update(f"{tensor.dtype}{list(tensor.shape)}".encode())
        found.update(tensor.reshape(-1).view(torch.uint8).numpy().data)
    return found.hexdigest()


def _to_json(value: Any, tensors: dict[str, Tensor]) -> Any:
    """A node as JSON: plain values as they are, everything else as a list [kind, …]."""
    if value is None or type(value) in (bool, int, float, str):
        return value
    if isinstance(value, (tuple, list)):
        return [type(value).__name__, [_to_json(item, tensors) for item in value]]
    if isinstance(value, dict):
        return ["dict", [[_to_json(item, tensors) for item in pair] for pair in value.items()]]
    if isinstance(value, Tensor):
        return ["tensor", _keep(value.detach().cpu(), tensors)]
    if isinstance(value, (np.ndarray, np.generic)):
        array = np.asarray(value)
        if array.dtype.kind == "U":
            return ["strings", array.tolist(), array.dtype.str]
        return ["array", _keep(torch.from_numpy(np.array(array, order="C")), tensors), array.dtype.str]
    kind = type(value)
    assert dataclasses.is_dataclass(kind), f"a state cannot hold a {kind.__name__}"
    fields = {field.name: _to_json(getattr(value, field.name), tensors) for field in dataclasses.fields(value)}
    return ["dataclass", kind.__module__, kind.__qualname__, fields]


def _keep(tensor: Tensor, tensors: dict[str, Tensor]) -> str:
    name = str(len(tensors))
    tensors[name] = tensor.clone(memory_format=torch.contiguous_format)
    return name


def _from_json(node: Any, tensors: dict[str, Tensor]) -> Any:
    if not isinstance(node, list):
        return node
    kind, content, *more = node
    if kind in ("tuple", "list"):
        items = [_from_json(item, tensors) for item in content]
        return tuple(items) if kind == "tuple" else items
    if kind == "dict":
        return {_from_json(key, tensors): _from_json(item, tensors) for key, item in content}
    if kind == "tensor":
        return tensors[content]
    if kind == "strings":
        return np.array(content, dtype=more[0])
    if kind == "array":
        return tensors[content].numpy().astype(more[0], copy=False)
    if kind == "dataclass":
        return _rebuilt(content, more[0], {name: _from_json(item, tensors) for name, item in more[1].items()})
    raise ValueError(f'unknown kind "{kind}"')


def _rebuilt(module: str, name: str, fields: dict[str, Any]) -> Any:
    """An instance of a dataclass of a module of this package that is imported already."""
    kind = getattr(sys.modules.get(module), name, None) if module.startswith("bevcli.") else None
    if not (isinstance(kind, type) and dataclasses.is_dataclass(kind)):
        raise ValueError(f"{module}.{name} is not a state of this version")
    if {field.name for field in dataclasses.fields(kind)} != fields.keys():
        raise ValueError(f"{module}.{name} has other fields in this version")
    instance = object.__new__(kind)
    for field, value in fields.items():
        object.__setattr__(instance, field, value)
    return instance
