"""Reads sample_annotation.json and derives velocities as the official devkit does."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.geometry.transforms import Array
from bevcli.sequences.nuscenes.index import Annotations, Ints
from bevcli.sequences.nuscenes.json_tables import (
    Row,
    column,
    integers,
    places_of,
    quaternions,
    read_batches,
    read_rows,
    texts,
    tokens,
    vectors,
)

MAX_GAP_S = 1.5  # longest time between two annotations of an object from which a velocity is derived


def read_annotations(
    tables: Path, sample_tokens: NDArray[np.bytes_], sample_times_us: Ints
) -> tuple[Annotations, Ints]:
    """The annotations ordered by sample, and the row of each sample's first annotation (N + 1,).

    A version without annotations, such as the test split, gives zero rows.

    sample_tokens: (N,). sample_times_us: (N,) microseconds.
    Raises InputError if the tables are inconsistent.
    """
    path = tables / "sample_annotation.json"
    names = _Names(tables)
    parts = [_columns(batch, path, names) for batch in (read_batches(path) if path.is_file() else ()) if batch]
    if not parts:
        return _no_annotations(), np.zeros(len(sample_tokens) + 1, dtype=np.int64)
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    samples = places_of(columns.pop("samples"), sample_tokens, tables / "sample.json")
    own, earlier, later = columns.pop("tokens"), columns.pop("prev"), columns.pop("next")
    velocities = _velocities(own, earlier, later, columns["centers"], sample_times_us[samples], path)
    order = np.argsort(samples, kind="stable")
    annotations = Annotations(
        **{name: values[order] for name, values in columns.items()}, velocities=velocities[order, :2]
    )
    return annotations, np.searchsorted(samples[order], np.arange(len(sample_tokens) + 1))


class _Names:
    """The names behind the tokens in an annotation."""

    def __init__(self, tables: Path) -> None:
        categories = _texts(tables / "category.json", "name")
        path = tables / "instance.json"
        instances = _optional_rows(path)
        owners, own = texts(instances, "category_token", path), texts(instances, "token", path)
        for token in owners:
            if token not in categories:
                raise InputError(f'{path}: category "{token}" is missing in category.json')
        self.category = {token: categories[owner].encode() for token, owner in zip(own, owners, strict=True)}
        self.attribute = {token: name.encode() for token, name in _texts(tables / "attribute.json", "name").items()}
        self.visibility = {
            token: _middle(level, tables) for token, level in _texts(tables / "visibility.json", "level").items()
        }


def _optional_rows(path: Path) -> list[Row]:
    return read_rows(path) if path.is_file() else []


def _texts(path: Path, name: str) -> dict[str, str]:
    rows = _optional_rows(path)
    return dict(zip(texts(rows, "token", path), texts(rows, name, path), strict=True))


def _middle(level: str, tables: Path) -> float:
    """The middle of a visibility level such as "v40-60", as a fraction from 0 to 1."""
    found = re.fullmatch(r"v([0-9]{1,3})-([0-9]{1,3})", level)
    if found is None:
        raise InputError(f'{tables / "visibility.json"}: unknown level "{level:.40}" (expected such as v40-60)')
    return (int(found[1]) + int(found[2])) / 200


def _columns(rows: list[Row], path: Path, names: _Names) -> dict[str, NDArray]:
    instances = texts(rows, "instance_token", path)
    attributes = column(rows, "attribute_tokens", path)
    visibilities = texts(rows, "visibility_token", path)
    if not all(type(own) is list and all(type(token) is str for token in own) for own in attributes):
        raise InputError(f'{path}: "attribute_tokens": expected a list of tokens in every row')
    return {
        "tokens": tokens(rows, "token", path),
        "samples": tokens(rows, "sample_token", path),
        "prev": tokens(rows, "prev", path),
        "next": tokens(rows, "next", path),
        "categories": np.array([names.category.get(token, b"") for token in instances]),
        "attributes": np.array([names.attribute.get(own[0], b"") if own else b"" for own in attributes]),
        "instances": tokens(rows, "instance_token", path),
        "centers": vectors(rows, "translation", path, 3),
        "sizes_wlh": vectors(rows, "size", path, 3),
        "quaternions": quaternions(rows, "rotation", path),
        "visibilities": np.array([names.visibility.get(token, np.nan) for token in visibilities]),
        "num_points": integers(rows, "num_lidar_pts", path) + integers(rows, "num_radar_pts", path),
    }


def _velocities(
    own: NDArray[np.bytes_],
    earlier: NDArray[np.bytes_],
    later: NDArray[np.bytes_],
    centers: Array,
    times_us: Ints,
    path: Path,
) -> Array:
    """(A, 3) m/s in the world frame, NaN if unknown: central differences, one-sided for first and last annotations.

    As in the official devkit, a velocity is known if each time gap is at most 1.5 s on average.
    """
    first, last = np.arange(len(own)), np.arange(len(own))
    has_earlier, has_later = earlier != b"", later != b""
    first[has_earlier] = places_of(earlier[has_earlier], own, path)
    last[has_later] = places_of(later[has_later], own, path)
    seconds = (times_us[last] - times_us[first]) * 1e-6
    longest = MAX_GAP_S * np.where(has_earlier & has_later, 2, 1)
    known = (has_earlier | has_later) & (seconds > 0) & (seconds <= longest)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(known[:, None], (centers[last] - centers[first]) / seconds[:, None], np.nan)


def _no_annotations() -> Annotations:
    text = np.zeros(0, dtype="S1")
    vectors = np.zeros((0, 3))
    return Annotations(
        categories=text,
        attributes=text,
        instances=text,
        centers=vectors,
        sizes_wlh=vectors,
        quaternions=np.zeros((0, 4)),
        velocities=np.zeros((0, 2)),
        visibilities=np.zeros(0),
        num_points=np.zeros(0, dtype=np.int64),
    )
