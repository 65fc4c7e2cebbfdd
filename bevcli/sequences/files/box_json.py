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
from bevcli.sequences.files.json_fields import array_of_numbers

KEYS = frozenset((
    "class", "center", "size_lwh", "yaw", "velocity", "score", "attribute", "instance", "track_score", "duplicate",
    "visibility", "num_points", "futures", "future_times_s", "future_scores",
))  # fmt: skip
# Keys of optional columns: type, value where a box has none, and a text for messages.
PLAIN: dict[str, tuple[Any, Any, str]] = {
    "attribute": (str, "", "a string"),
    "instance": (str, "", "a string"),
    "duplicate": (bool, False, "true or false"),
    "num_points": (int, -1, "an integer, 0 or more"),
}
FUTURE_DECIMALS = 3  # millimetres
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
        centers=_numbers([box["center"] for box in objects], 3, where, "center"),
        sizes_lwh=_numbers([box["size_lwh"] for box in objects], 3, where, "size_lwh"),
        yaws=_numbers([box["yaw"] for box in objects], 1, where, "yaw"),
        velocities=_velocities([box.get("velocity") for box in objects], where),
        classes=np.array([class_names[box["class"]] for box in objects]),
        scores=_shares(objects, "score", where, required=True),
        attributes=_plain(objects, "attribute", where),
        instances=_plain(objects, "instance", where),
        track_scores=_shares(objects, "track_score", where),
        duplicates=_plain(objects, "duplicate", where),
        visibilities=_shares(objects, "visibility", where),
        num_points=_plain(objects, "num_points", where),
        **_futures_from_json(objects, where),
    )
    for key, column in (("center", boxes.centers), ("size_lwh", boxes.sizes_lwh), ("yaw", boxes.yaws)):
        _require(np.isfinite(column), column, where, key, "finite numbers")
    _require(boxes.sizes_lwh > 0, boxes.sizes_lwh, where, "size_lwh", "numbers above 0")
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
    _add_futures(objects, boxes)
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
    array = array_of_numbers(values)
    if array is not None and array.shape == ((len(values),) if width == 1 else (len(values), width)):
        return array
    expected = "a number" if width == 1 else f"{width} numbers"
    for place, value in enumerate(values):
        entries = value if isinstance(value, list) and width > 1 else [value]
        if len(entries) != width or not all(type(entry) in (int, float) for entry in entries):
            raise InputError(f"{where}: box {place}: {key}: expected {expected}, found {value!r:.60}")
    return np.asarray(values, dtype=np.float64)  # integers too large for int64


def _require(good: NDArray[np.bool_], column: Array, where: str, key: str, expected: str) -> None:
    if not good.all():
        place = int(np.argmin(good.reshape(len(good), -1).all(axis=1)))
        raise InputError(f"{where}: box {place}: {key}: expected {expected}, found {column[place].tolist()}")


def _velocities(values: list[Any], where: str) -> Array:
    with_nan = [
        [math.nan if number is None else number for number in value] if isinstance(value, list) else value
        for value in ([None, None] if value is None else value for value in values)
    ]
    return _numbers(with_nan, 2, where, "velocity")


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
    numbers = _numbers([math.nan if v is None and not required else v for v in values], 1, where, key)
    good = ((numbers >= 0) & (numbers <= 1)) | (np.isnan(numbers) & (not required))
    _require(good, numbers, where, key, "0 to 1")
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


def _add_futures(objects: Sequence[dict[str, Any]], boxes: Boxes3D) -> None:
    """Add futures to N JSON objects: M modes of T steps, each x and y, null if unknown; and the times of the steps."""
    if boxes.futures is None:
        return
    for place, box in enumerate(objects):
        future = boxes.futures[place]  # (M, T, 3)
        if not np.isfinite(future[..., 1:]).any():
            continue
        box["future_times_s"] = future[0, :, 0].tolist()
        modes = future[..., 1:].round(FUTURE_DECIMALS).tolist()
        box["futures"] = [[None if math.isnan(point[0]) else point for point in mode] for mode in modes]
        if boxes.future_scores is not None:
            box["future_scores"] = boxes.future_scores[place].tolist()


def _futures_from_json(objects: Sequence[dict[str, Any]], where: str) -> dict[str, Array]:
    """The columns `futures` and `future_scores` of Boxes3D, none where no box has them."""
    found = {place: _future(box, f"{where}: box {place}") for place, box in enumerate(objects) if "futures" in box}
    if not found:
        return {}
    shape = next(iter(found.values())).shape
    futures, scores = np.full((len(objects), *shape), np.nan), np.full((len(objects), shape[0]), np.nan)
    for place, future in found.items():
        if future.shape != shape:
            raise InputError(
                f"{where}: box {place}: futures: {future.shape[0]} modes of {future.shape[1]} steps (expected "
                f"{shape[0]} of {shape[1]}, as in the other boxes of the frame)"
            )
        futures[place] = future
        if "future_scores" in (box := objects[place]):
            scores[place] = _array(box["future_scores"], shape[:1], f"{where}: box {place}: future_scores")
    has_scores = any("future_scores" in box for box in objects)
    return {"futures": futures, **({"future_scores": scores} if has_scores else {})}


def _future(box: dict[str, Any], where: str) -> Array:
    """(M, T, 3) of one box."""
    times, modes = box.get("future_times_s"), box["futures"]
    if not isinstance(times, list) or not isinstance(modes, list) or not times or not modes:
        raise InputError(f'{where}: expected lists "futures" and "future_times_s", found {modes!r:.40}, {times!r:.40}')
    filled = [
        [[math.nan] * 2 if point is None else point for point in mode] if isinstance(mode, list) else mode
        for mode in modes
    ]
    places = _array(filled, (len(modes), len(times), 2), f"{where}: futures")
    seconds = _array(times, (len(times),), f"{where}: future_times_s")[:, None]
    return np.concatenate([np.broadcast_to(seconds, (*places.shape[:2], 1)), places], axis=-1)


def _array(values: Any, shape: tuple[int, ...], where: str) -> Array:
    found = array_of_numbers(values)
    if found is None or found.shape != shape:
        raise InputError(f"{where}: expected {' x '.join(map(str, shape))} numbers, found {values!r:.60}")
    return found
