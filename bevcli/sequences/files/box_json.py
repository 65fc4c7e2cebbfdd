"""Conversion between Boxes3D and JSON, one object per box. All boxes of a frame are checked at once, for speed."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array
from bevcli.sequences.files.class_names import ClassNames
from bevcli.sequences.files.future_json import add_futures, futures_from_json

KEYS = frozenset(
    (
        "class", "center", "size_lwh", "yaw", "velocity", "score", "attribute", "instance", "track_score", "duplicate",
        "visibility", "num_points", "futures", "future_times_s", "future_scores",
    )
)  # fmt: skip
# Keys of optional columns: type, value where a box has none, and a text for messages.
PLAIN: dict[str, tuple[Any, Any, str]] = {
    "attribute": (str, "", "a string"),
    "instance": (str, "", "a string"),
    "duplicate": (bool, False, "true or false"),
    "num_points": (int, -1, "an integer, 0 or more"),
}
_OWN_NAMES = ClassNames()


def boxes_from_json(objects: Any, where: str, class_names: ClassNames = _OWN_NAMES) -> Boxes3D:
    """N boxes from a list of N JSON objects. A missing or null velocity becomes NaN.

    where: start of an error message, such as "boxes.json: frame 3". class_names: maps the classes; names that it does
    not know are kept.
    Raises InputError that names the first invalid box by its index in the list.
    """
    if not isinstance(objects, list):
        raise InputError(f'{where}: "boxes" must be a list, found {objects!r:.40}')
    if not objects:
        return Boxes3D.empty()
    _check_keys(objects, where)
    boxes = Boxes3D(
        centers=_numbers([box["center"] for box in objects], 3, f"{where}: box", "center"),
        sizes_lwh=_numbers([box["size_lwh"] for box in objects], 3, f"{where}: box", "size_lwh"),
        yaws=_numbers([box["yaw"] for box in objects], 1, f"{where}: box", "yaw"),
        velocities=_velocities([box.get("velocity") for box in objects], where),
        classes=np.array([class_names[box["class"]] for box in objects]),
        scores=_shares(objects, "score", where, required=True),
        attributes=_plain(objects, "attribute", where),
        instances=_plain(objects, "instance", where),
        track_scores=_shares(objects, "track_score", where),
        duplicates=_plain(objects, "duplicate", where),
        visibilities=_shares(objects, "visibility", where),
        num_points=_plain(objects, "num_points", where),
        **futures_from_json(objects, where),
    )
    for key, column in (("center", boxes.centers), ("size_lwh", boxes.sizes_lwh), ("yaw", boxes.yaws)):
        _require(np.isfinite(column), column, f"{where}: box", key, "finite numbers")
    _require(boxes.sizes_lwh > 0, boxes.sizes_lwh, f"{where}: box", "size_lwh", "numbers above 0")
    return boxes


def boxes_to_json(boxes: Boxes3D) -> list[dict[str, Any]]:
    """N JSON objects. Unknown values (NaN visibility, "" names, -1 points) are left out; NaN velocities become null.

    "duplicate" is written only where it is true.
    """
    velocities = [[None if math.isnan(v) else v for v in row] for row in boxes.velocities.tolist()]
    columns: dict[str, list[Any]] = {
        "class": boxes.classes.tolist(),
        "center": boxes.centers.tolist(),
        "size_lwh": boxes.sizes_lwh.tolist(),
        "yaw": boxes.yaws.tolist(),
        "velocity": velocities,
    }
    objects = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
    optional = (
        ("score", boxes.scores, lambda value: True),
        ("attribute", boxes.attributes, lambda value: value != ""),
        ("instance", boxes.instances, lambda value: value != ""),
        ("track_score", boxes.track_scores, lambda value: not math.isnan(value)),
        ("duplicate", boxes.duplicates, lambda value: value),
        ("visibility", boxes.visibilities, lambda value: not math.isnan(value)),
        ("num_points", boxes.num_points, lambda value: value >= 0),
    )
    for key, column, known in optional:
        if column is not None:
            for box, value in zip(objects, column.tolist(), strict=True):
                if known(value):
                    box[key] = value
    add_futures(objects, boxes)
    return objects


def _check_keys(objects: Sequence[Any], where: str) -> None:
    for place, box in enumerate(objects):
        if not isinstance(box, dict):
            raise InputError(f"{where}: box {place}: expected an object, found {box!r:.40}")
        for key in ("class", "center", "size_lwh", "yaw"):
            if key not in box:
                raise InputError(f'{where}: box {place}: "{key}" is missing (found: {", ".join(box)})')
        if not isinstance(box["class"], str) or not box["class"]:
            raise InputError(f"{where}: box {place}: class: expected a name, found {box['class']!r:.40}")
        if not KEYS.issuperset(box):
            unknown = next(key for key in box if key not in KEYS)
            raise InputError(f'{where}: box {place}: unknown key "{unknown}" (known: {", ".join(sorted(KEYS))})')


def _numbers(values: list[Any], width: int, where: str, key: str) -> Array:
    """(N, width) float64, or (N,) for width 1. The caller has replaced allowed nulls by NaN."""
    shape = (len(values),) if width == 1 else (len(values), width)
    try:
        array = np.asarray(values)
    except ValueError:  # ragged lists
        array = np.asarray(None)
    if array.shape == shape and array.dtype.kind in "iuf":
        return array.astype(np.float64, copy=False)
    expected = "a number" if width == 1 else f"{width} numbers"
    for place, value in enumerate(values):
        single = np.asarray(value, dtype=object) if isinstance(value, list) else np.asarray(value)
        entries = value if isinstance(value, list) else [value]
        if single.shape != shape[1:] or not all(type(entry) in (int, float) for entry in entries):
            raise InputError(f"{where} {place}: {key}: expected {expected}, found {value!r:.60}")
    return np.asarray(values, dtype=np.float64)  # integers too large for int64


def _require(good: NDArray[np.bool_], column: Array, where: str, key: str, expected: str) -> None:
    if not good.all():
        place = int(np.argmin(good.reshape(len(good), -1).all(axis=1)))
        raise InputError(f"{where} {place}: {key}: expected {expected}, found {column[place].tolist()}")


def _velocities(values: list[Any], where: str) -> Array:
    with_nan = [
        [math.nan if number is None else number for number in value] if isinstance(value, list) else value
        for value in ([None, None] if value is None else value for value in values)
    ]
    return _numbers(with_nan, 2, f"{where}: box", "velocity")


def _shares(objects: Sequence[dict[str, Any]], key: str, where: str, *, required: bool = False) -> Array | None:
    """An optional column of numbers from 0 to 1, NaN where a box has none.

    required: whether every box must have one if any has.
    """
    if not any(key in box for box in objects):
        return None
    for place, box in enumerate(objects if required else ()):
        if key not in box:
            raise InputError(f'{where}: box {place}: "{key}" is missing (other boxes of the frame have one)')
    values = [box.get(key) for box in objects]
    numbers = _numbers([math.nan if v is None and not required else v for v in values], 1, f"{where}: box", key)
    good = ((numbers >= 0) & (numbers <= 1)) | (np.isnan(numbers) & (not required))
    _require(good, numbers, f"{where}: box", key, "0 to 1")
    return numbers


def _plain(objects: Sequence[dict[str, Any]], key: str, where: str) -> NDArray[Any] | None:
    """An optional column of texts, flags or counts, with a default where a box has none."""
    if not any(key in box for box in objects):
        return None
    kind, default, expected = PLAIN[key]
    values: list[Any] = [default if kind is str and not box.get(key) else box.get(key, default) for box in objects]
    for place, value in enumerate(values):
        if type(value) is not kind or (kind is int and key in objects[place] and value < 0):
            raise InputError(f"{where}: box {place}: {key}: expected {expected}, found {value!r:.40}")
    return np.array(values)
