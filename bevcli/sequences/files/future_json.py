"""The futures of boxes in JSON: M modes of T steps, each x and y, with the times of the steps."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array

DECIMALS = 3  # millimetres


def add_futures(objects: Sequence[dict[str, Any]], boxes: Boxes3D) -> None:
    """Add the futures of N boxes to their N JSON objects; unknown places become null."""
    if boxes.futures is None:
        return
    scores = boxes.future_scores
    for place, box in enumerate(objects):
        future = boxes.futures[place]  # (M, T, 3)
        if not np.isfinite(future[..., 1:]).any():
            continue
        box["future_times_s"] = future[0, :, 0].tolist()
        box["futures"] = [[_known(point) for point in mode] for mode in future[..., 1:].round(DECIMALS).tolist()]
        if scores is not None:
            box["future_scores"] = scores[place].tolist()


def _known(point: list[float]) -> list[float] | None:
    return None if math.isnan(point[0]) else point


def futures_from_json(objects: Sequence[dict[str, Any]], where: str) -> dict[str, Array]:
    """The columns `futures` and `future_scores` of Boxes3D, none where no box has them.

    where: start of an error message. Raises InputError where boxes differ in the number of modes or steps.
    """
    stated = [place for place, box in enumerate(objects) if "futures" in box]
    if not stated:
        return {}
    found = {place: _future(objects[place], f"{where}: box {place}") for place in stated}
    shape = found[stated[0]].shape
    futures, scores = np.full((len(objects), *shape), np.nan), np.full((len(objects), shape[0]), np.nan)
    for place, future in found.items():
        if future.shape != shape:
            raise InputError(
                f"{where}: box {place}: futures: {future.shape[0]} modes of {future.shape[1]} steps (expected "
                f"{shape[0]} of {shape[1]}, as in the other boxes of the frame)"
            )
        futures[place] = future
        if "future_scores" in (box := objects[place]):
            scores[place] = _numbers(box["future_scores"], shape[:1], f"{where}: box {place}: future_scores")
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
    places = _numbers(filled, (len(modes), len(times), 2), f"{where}: futures")
    seconds = _numbers(times, (len(times),), f"{where}: future_times_s")[:, None]
    return np.concatenate([np.broadcast_to(seconds, (*places.shape[:2], 1)), places], axis=-1)


def _numbers(values: Any, shape: tuple[int, ...], where: str) -> Array:
    try:
        found = np.asarray(values)
    except ValueError:  # ragged lists
        found = np.zeros(0)
    if found.shape != shape or found.dtype.kind not in "iuf":
        expected = " x ".join(map(str, shape))
        raise InputError(f"{where}: expected {expected} numbers, found {values!r:.60}")
    return found.astype(np.float64)
