"""Line strips of several lengths as Arrow arrays. rerun converts a list of strips one by one, which takes long."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pyarrow as pa
import rerun as rr

from bevcli.geometry.transforms import Array


def strips_2d(strips: Sequence[Array]) -> pa.Array:
    """Strips (points, 2) for `rr.LineStrips2D`."""
    return _strips(strips, rr.components.LineStrip2DBatch._ARROW_DATATYPE, 2)


def strips_3d(strips: Sequence[Array]) -> pa.Array:
    """Strips (points, 3) for `rr.LineStrips3D`."""
    return _strips(strips, rr.components.LineStrip3DBatch._ARROW_DATATYPE, 3)


def _strips(strips: Sequence[Array], kind: pa.ListType, dimensions: int) -> pa.Array:
    offsets = np.cumsum([0, *map(len, strips)], dtype=np.int32)
    numbers = np.concatenate([np.zeros((0, dimensions)), *strips]).astype(np.float32).ravel()
    points = pa.FixedSizeListArray.from_arrays(pa.array(numbers), type=kind.value_type)
    return pa.ListArray.from_arrays(pa.array(offsets), points, type=kind)
