"""Components of a row as Arrow arrays, made without rerun's archetypes, whose conversions take ten times as long.

    log(stream, entity, components(rr.LineStrips2D, strips=segments, colors=colors, radii=ui_points(1.0)))

A row that is made so equals the one of `stream.log(entity, rr.LineStrips2D(segments, …))`.
"""

from collections.abc import Hashable, Sequence
from functools import cache, lru_cache
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from bevcli.geometry.transforms import Array

Components = dict[rr.ComponentDescriptor, pa.Array]
CONSTANTS = 4096  # that are kept as Arrow arrays


def log(stream: rr.RecordingStream, entity: str, row: Components, *, static: bool = False) -> None:
    """Writes a row, as `stream.log`, which takes twice as long."""
    rr.bindings.log_arrow_msg(entity, components=row, static_=static, recording=stream.to_native())


def components(archetype: Any, **fields: Any) -> Components:
    """The components of an archetype, a class of rerun such as `rr.Points2D`.

    fields: by the names of `archetype.from_fields`; None leaves one out. A field is an Arrow array of the component's
    type, an array of numbers (colours as `packed` takes or returns them), a list of texts, or what can be hashed and
    rerun takes, which is converted once.
    """
    row: Components = {}
    for name, value in fields.items():
        if value is not None:
            descriptor, arrow_type = _field(archetype, name)
            if isinstance(value, pa.Array):
                row[descriptor] = value
            elif isinstance(value, np.ndarray):
                row[descriptor] = _numbers(value, arrow_type)
            elif isinstance(value, list) and pa.types.is_string(arrow_type):
                row[descriptor] = pa.array(value, arrow_type)
            else:
                row[descriptor] = _constant(archetype, name, value)
    return row


def any_values(**values: Any) -> Components:
    """As `rr.AnyValues`, with the same type in every row: arrays of numbers or texts, or single values."""
    row: Components = {}
    for name, value in values.items():
        array = np.atleast_1d(value)  # typed, so that an array without values is a value too
        row[rr.ComponentDescriptor(name)] = (
            pa.array(array.tolist(), pa.utf8()) if array.dtype.kind == "U" else pa.array(array)
        )
    return row


@lru_cache(maxsize=64)
def ui_points(width: float) -> pa.Array:
    """A radius in points of the user interface, for all lines or points of an entity."""
    return rr.components.RadiusBatch(rr.Radius.ui_points(width)).as_arrow_array()


def line_strips(points: Array, lengths: Sequence[int]) -> pa.Array:
    """Strips, each with a number of points of its own. points: (P, 2 or 3) of all of them, one after the other."""
    _, arrow_type = _field(rr.LineStrips2D if points.shape[1] == 2 else rr.LineStrips3D, "strips")
    return _lists(points, np.cumsum([0, *lengths], dtype=np.int32), arrow_type)


@lru_cache(maxsize=64)
def rgb_format(width: int, height: int) -> pa.Array:
    """The format of an image (height, width, 3) of bytes, RGB."""
    image_format = rr.components.ImageFormat(width=width, height=height, channel_datatype="U8", color_model="RGB")
    return rr.components.ImageFormatBatch(image_format).as_arrow_array()


@cache
def _field(archetype: Any, name: str) -> tuple[rr.ComponentDescriptor, pa.DataType]:
    (batch,) = archetype.from_fields(**{name: []}).as_component_batches()
    return batch.component_descriptor(), batch.as_arrow_array().type


@lru_cache(maxsize=CONSTANTS)
def _constant(archetype: Any, name: str, value: Hashable) -> pa.Array:
    (batch,) = archetype.from_fields(**{name: value}).as_component_batches()
    return batch.as_arrow_array()


def _numbers(value: NDArray[Any], arrow_type: pa.DataType) -> pa.Array:
    if pa.types.is_uint32(arrow_type) and value.dtype == np.uint8:
        return pa.array(packed(value))
    if pa.types.is_list(arrow_type):  # strips (N, points, 2 or 3), or the bytes (N,) of a file or an image
        if value.ndim == 1:
            return _lists(value, np.array([0, len(value)], np.int32), arrow_type)
        offsets = np.arange(len(value) + 1, dtype=np.int32) * np.int32(value.shape[1])
        return _lists(value.reshape(-1, value.shape[2]), offsets, arrow_type)
    is_vector = pa.types.is_fixed_size_list(arrow_type)
    of_number = (arrow_type.value_type if is_vector else arrow_type).to_pandas_dtype()
    numbers = pa.array(value.reshape(-1).astype(of_number, copy=False))
    return pa.FixedSizeListArray.from_arrays(numbers, type=arrow_type) if is_vector else numbers


def _lists(rows: NDArray[Any], offsets: NDArray[np.int32], arrow_type: pa.DataType) -> pa.Array:
    """Lists of consecutive rows: numbers, or vectors (N, 2 or 3)."""
    return pa.ListArray.from_arrays(pa.array(offsets), _numbers(rows, arrow_type.value_type), type=arrow_type)


def packed(colors: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """Colours (N, 3 or 4) -> (N,), red in the highest byte, then green, blue and opacity."""
    if colors.shape[-1] == 3:
        opaque = np.full((len(colors), 4), 255, np.uint8)
        opaque[:, :3] = colors
        colors = opaque
    return np.ascontiguousarray(colors).view(">u4").reshape(-1).astype(np.uint32)
