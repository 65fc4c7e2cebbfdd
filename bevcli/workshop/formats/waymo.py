"""Waymo's nine intrinsics of a camera: f_u, f_v, c_u, c_v, k1, k2, p1, p2, k3."""

from collections.abc import Mapping
from typing import Any

from bevcli.sequences.files.json_fields import array_of_numbers

NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")


def with_intrinsics_by_name(entry: Mapping[str, Any]) -> Mapping[str, Any]:
    """The statements of a camera, with Waymo's nine numbers by name. The last of nine numbers of a matrix is 1."""
    for key in ("intrinsic", "intrinsics"):
        numbers = array_of_numbers(entry.get(key))
        if numbers is not None and numbers.shape == (9,) and numbers[8] != 1:
            return {**entry, key: None, **dict(zip(NAMES, numbers.tolist(), strict=True))}
    return entry
