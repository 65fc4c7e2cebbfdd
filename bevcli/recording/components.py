"""Components of a row as Arrow arrays, made without rerun's archetypes, whose conversions take ten times as long.

    stream.log(entity, components(rr.LineStrips2D, strips=segments, colors=colors, radii=ui_points(1.0)))

A row that is made so equals the one of `rr.LineStrips2D(segments, …)`.
"""

from collections.abc import Hashable, Sequence
from functools import cache, lru_cache
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from bevcli.geometry.transforms import Array

Components = list[rr.DescribedComponentBatch]
CONSTANTS = 4096  # that are kept as Arrow arrays


class _Component(rr.DescribedComponentBatch):
    """An Arrow array with the name and the type of a component."""

    def __init__(self, array: pa.Array, descriptor: rr.ComponentDescriptor) -> None:
        self._array, self._descriptor = array, descriptor

    def component_descriptor(self) -> rr.ComponentDescriptor:
        return self._descriptor

    def as_arrow_array(self) -> pa.Array:
        return self._array


def components(archetype: Any, **fields: Any) -> Components:
    """The components of an archetype, a class of rerun such as `rr.Points2D`.

    fields: by the names of `archetype.from_fields`; None leaves one out. A field is an Arrow array of the component's
    type, an array of numbers (colours as `packed` takes or returns them), a list of texts, or whatever rerun takes. A
    value that can be hashed is converted once.
    """
    batches: Components = []
    for name, value in fields.items():
        if value is not None:
            descriptor, kind = _field(archetype, name)
            batches.append(_Component(_converted(archetype, name, kind, value), descriptor))
    return batches


def any_values(**values: Any) -> Components:
    """As `rr.AnyValues`, with the same type in every row: arrays of numbers, Arrow arrays, or single values."""
    arrays = {name: v if isinstance(v, pa.Array) else pa.array(np.atleast_1d(v)) for name, v in values.items()}
    return [_Component(array, rr.ComponentDescriptor(name)) for name, array in arrays.items()]


@lru_cache(maxsize=64)
def ui_points(width: float) -> pa.Array:
    """A radius in points of the user interface, for all lines or points of an entity."""
    return rr.components.RadiusBatch(rr.Radius.ui_points(width)).as_arrow_array()


def line_strips(strips: Sequence[Array], dimensions: int) -> pa.Array:
    """Strips (points, 2 or 3), each with a number of points of its own."""
    _, kind = _field(rr.LineStrips2D if dimensions == 2 else rr.LineStrips3D, "strips")
    points = np.concatenate(strips) if len(strips) else np.zeros((0, dimensions))
    return _lists(points, np.cumsum([0, *map(len, strips)], dtype=np.int32), kind)


def blob(data: bytes | NDArray[np.uint8]) -> pa.Array:
    """Bytes, such as those of a file or of an image, as one component."""
    numbers = np.frombuffer(data, np.uint8) if isinstance(data, bytes) else np.ascontiguousarray(data).reshape(-1)
    return _lists(numbers, np.array([0, len(numbers)], dtype=np.int32), _field(rr.EncodedImage, "blob")[1])


@lru_cache(maxsize=64)
def rgb_format(width: int, height: int) -> pa.Array:
    """The format of an image (height, width, 3) of bytes, RGB."""
    kind = rr.components.ImageFormat(width=width, height=height, channel_datatype="U8", color_model="RGB")
    return rr.components.ImageFormatBatch(kind).as_arrow_array()


@cache
def _field(archetype: Any, name: str) -> tuple[rr.ComponentDescriptor, pa.DataType]:
    (batch,) = archetype.from_fields(**{name: []}).as_component_batches()
    return batch.component_descriptor(), batch.as_arrow_array().type


def _converted(archetype: Any, name: str, kind: pa.DataType, value: Any) -> pa.Array:
    if isinstance(value, pa.Array):
        return value
    if isinstance(value, np.ndarray):
        return _numbers(value, kind)
    if isinstance(value, list) and pa.types.is_string(kind):
        return pa.array(value, kind)
    return _constant(archetype, name, value) if isinstance(value, Hashable) else _by_rerun(archetype, name, value)


def _by_rerun(archetype: Any, name: str, value: Any) -> pa.Array:
    (batch,) = archetype.from_fields(**{name: value}).as_component_batches()
    return batch.as_arrow_array()


_constant = lru_cache(maxsize=CONSTANTS)(_by_rerun)


def _numbers(value: NDArray[Any], kind: pa.DataType) -> pa.Array:
    if pa.types.is_uint32(kind) and value.dtype == np.uint8:
        return pa.array(packed(value))
    if pa.types.is_list(kind):  # strips (N, points, 2 or 3)
        offsets = np.arange(len(value) + 1, dtype=np.int32) * np.int32(value.shape[1])
        return _lists(value.reshape(-1, value.shape[2]), offsets, kind)
    if pa.types.is_fixed_size_list(kind):
        return _vectors(value, kind)
    return pa.array(value.reshape(-1).astype(kind.to_pandas_dtype(), copy=False))


def _lists(rows: NDArray[Any], offsets: NDArray[np.int32], kind: pa.DataType) -> pa.Array:
    """Lists of consecutive rows: numbers, or vectors (N, 2 or 3)."""
    whole = _vectors(rows, kind.value_type) if rows.ndim > 1 else pa.array(rows)
    return pa.ListArray.from_arrays(pa.array(offsets), whole, type=kind)


def _vectors(value: NDArray[Any], kind: pa.DataType) -> pa.Array:
    numbers = value.reshape(-1).astype(kind.value_type.to_pandas_dtype(), copy=False)
    return pa.FixedSizeListArray.from_arrays(pa.array(numbers), type=kind)


def packed(colors: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """Colours (N, 3 or 4) -> (N,), red in the highest byte, then green, blue and opacity."""
    if colors.shape[-1] == 3:
        opaque = np.full((len(colors), 4), 255, np.uint8)
        opaque[:, :3] = colors
        colors = opaque
    return np.ascontiguousarray(colors).view(">u4").reshape(-1).astype(np.uint32)
