"""Builds a NuScenesIndex from nuScenes' JSON tables: joins them by token and sorts rows by scene and time."""

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.geometry.transforms import Array
from bevcli.parsing.documents import without_garbage_collection
from bevcli.sequences.nuscenes.index import Annotations, Dialect, Images, Ints, NuScenesIndex, Samples, Scenes, Sensors
from bevcli.sequences.nuscenes.json_tables import (
    Row,
    array_of,
    by_token,
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
from bevcli.sequences.tracks import velocities_between

Columns = dict[str, NDArray]  # the columns of a table by name, as many rows each


def build_index(tables: Path, dialect: Dialect) -> NuScenesIndex:
    """Read the folder with one version's tables. Raises InputError if one is missing, invalid or inconsistent."""
    with without_garbage_collection():
        sensor_tokens, sensors = _read_sensors(tables)
        names, sample_tokens, sample_times, sample_scenes = _read_samples(tables)
        data = _read_sensor_data(tables, sample_tokens, sensor_tokens, sensors, dialect)
        data["translations"], data["quaternions"] = _read_poses(tables, data.pop("poses"))
        lidar = np.isin(sensors.channels[data["sensors"]], dialect.lidars)
        lidar_rows = _lidar_of_samples(tables, data["samples"], np.flatnonzero(lidar), sample_tokens, dialect)
        image_rows = np.flatnonzero(~lidar)
        owners, times = sample_scenes[data["samples"][image_rows]], data["times_us"][image_rows]
        images = Images(**_rows(data, image_rows[np.lexsort((times, owners))]))
        annotations, first_annotation = read_annotations(tables, sample_tokens, sample_times, dialect)
    return NuScenesIndex(
        Scenes(names, _starts(sample_scenes, len(names)), _starts(sample_scenes[images.samples], len(names))),
        sensors,
        Samples(
            sample_tokens,
            sample_times,
            data["translations"][lidar_rows],
            data["quaternions"][lidar_rows],
            data["sensors"][lidar_rows],
            first_annotation,
        ),
        images,
        annotations,
    )


def _rows(columns: Columns, rows: Ints) -> Columns:
    return {name: values[rows] for name, values in columns.items()}


def _joined(parts: list[Columns]) -> Columns:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _read_sensors(tables: Path) -> tuple[NDArray[np.bytes_], Sensors]:
    path = tables / "calibrated_sensor.json"
    channels = by_token(tables / "sensor.json", "channel")
    rows = read_rows(path)
    sensors = Sensors(
        np.array([channels.get(token, "") for token in texts(rows, "sensor_token", path)], dtype=np.str_),
        vectors(rows, "translation", path, 3),
        quaternions(rows, "rotation", path),
        np.array([_intrinsics(row, path) for row in rows], dtype=np.float64).reshape(-1, 3, 3),
        np.array([_distortion(row, path) for row in rows], dtype=np.float64).reshape(-1, 8),
    )
    return tokens(rows, "token", path), sensors


def _intrinsics(row: Row, path: Path) -> Array:
    """(3, 3) pixels; NaN for a sensor that is no camera."""
    value = row.get("camera_intrinsic")
    if not value:
        return np.full((3, 3), np.nan)
    array = array_of(value, (3, 3))
    if array is None or not min(array[0, 0], array[1, 1]) > 0:
        raise InputError(f'{path}: "camera_intrinsic": expected a camera matrix of 3x3 numbers, or []')
    return array


def _distortion(row: Row, path: Path) -> Array:
    """(8,) Brown-Conrady coefficients. nuScenes has none; T4 adds the column."""
    value = row.get("camera_distortion") or []
    array = array_of(value, (len(value),)) if type(value) is list and len(value) in (0, 4, 5, 8) else None
    if array is None:
        raise InputError(f'{path}: "camera_distortion": expected 0, 4, 5 or 8 numbers: k1 k2 p1 p2 [k3 [k4 k5 k6]]')
    return np.pad(array, (0, 8 - len(array)))


def _read_samples(tables: Path) -> tuple[NDArray[np.str_], NDArray[np.bytes_], Ints, Ints]:
    """Scene names (S,), and the tokens, times in us and scenes of samples (N,), ordered by scene and time."""
    scene_path, path = tables / "scene.json", tables / "sample.json"
    scenes, rows = read_rows(scene_path), read_rows(path)
    if not scenes or not rows:
        raise InputError(f"{path if scenes else scene_path}: the table has no rows (expected at least one)")
    in_scene = places_of(tokens(rows, "scene_token", path), tokens(scenes, "token", scene_path), scene_path)
    times = integers(rows, "timestamp", path)
    order = np.lexsort((times, in_scene))
    names = np.array(texts(scenes, "name", scene_path), dtype=np.str_)
    return names, tokens(rows, "token", path)[order], times[order], in_scene[order]


def _read_sensor_data(
    tables: Path,
    sample_tokens: NDArray[np.bytes_],
    sensor_tokens: NDArray[np.bytes_],
    sensors: Sensors,
    dialect: Dialect,
) -> Columns:
    """Columns of sample_data.json for images, and for lidars at keyframes. Samples and sensors are rows."""
    path = tables / "sample_data.json"
    lidars = {token.decode() for token in sensor_tokens[np.isin(sensors.channels, dialect.lidars)]}
    cameras = {token.decode() for token in sensor_tokens[np.isfinite(sensors.intrinsics).all((1, 2))]}
    parts = []
    for batch in read_batches(path):
        owners, keys = texts(batch, "calibrated_sensor_token", path), column(batch, "is_key_frame", path)
        needed = [
            row
            for row, owner, key in zip(batch, owners, keys, strict=True)
            if (owner in cameras and row.get("is_valid") is not False) or (key and owner in lidars)
        ]
        if needed:
            parts.append(_sensor_data_of(needed, path, sample_tokens, sensor_tokens))
    if not parts:
        raise InputError(f"{path}: no row belongs to a camera (expected camera images)")
    return _joined(parts)


def _sensor_data_of(
    rows: list[Row], path: Path, sample_tokens: NDArray[np.bytes_], sensor_tokens: NDArray[np.bytes_]
) -> Columns:
    own_sensors = tokens(rows, "calibrated_sensor_token", path)
    return {
        "samples": places_of(tokens(rows, "sample_token", path), sample_tokens, path.with_name("sample.json")),
        "sensors": places_of(own_sensors, sensor_tokens, path.with_name("calibrated_sensor.json")),
        "poses": tokens(rows, "ego_pose_token", path),
        "times_us": integers(rows, "timestamp", path),
        "keys": integers(rows, "is_key_frame", path).astype(bool),
        "sizes": np.stack([integers(rows, "width", path), integers(rows, "height", path)], axis=1),
        "files": np.array([name.encode("utf-8", "surrogatepass") for name in texts(rows, "filename", path)]),
    }


def _read_poses(tables: Path, wanted: NDArray[np.bytes_]) -> tuple[Array, Array]:
    """Translations (P, 3), metres, and quaternions (P, 4) of world_from_ego for the pose tokens (P,)."""
    path = tables / "ego_pose.json"
    needed = {token.decode() for token in wanted}
    found, translations, rotations = [], [], []
    for batch in read_batches(path):
        rows = [row for row, token in zip(batch, texts(batch, "token", path), strict=True) if token in needed]
        if rows:
            found.append(tokens(rows, "token", path))
            translations.append(vectors(rows, "translation", path, 3))
            rotations.append(quaternions(rows, "rotation", path))
    places = places_of(wanted, np.concatenate(found) if found else np.zeros(0, "S32"), path)
    chosen = np.concatenate(rotations)[places]
    return np.concatenate(translations)[places], chosen / np.linalg.norm(chosen, axis=1, keepdims=True)


def _lidar_of_samples(
    tables: Path, samples: Ints, lidar_rows: Ints, sample_tokens: NDArray[np.bytes_], dialect: Dialect
) -> Ints:
    """(N,) the row of each sample's lidar keyframe."""
    rows = np.full(len(sample_tokens), -1, dtype=np.int64)
    rows[samples[lidar_rows]] = lidar_rows
    if (rows < 0).any():
        token = sample_tokens[rows < 0][0].decode()
        raise InputError(
            f'{tables / "sample_data.json"}: sample "{token}" has no keyframe of {" or ".join(dialect.lidars)}'
        )
    return rows


def _starts(sorted_owners: Ints, count: int) -> Ints:
    """(count + 1,) the first row of each owner."""
    return np.searchsorted(sorted_owners, np.arange(count + 1))


def read_annotations(
    tables: Path, sample_tokens: NDArray[np.bytes_], sample_times_us: Ints, dialect: Dialect
) -> tuple[Annotations, Ints]:
    """The annotations ordered by sample, and the row of each sample's first annotation (N + 1,).

    A version without annotations, such as the test split, gives zero rows.

    sample_tokens: (N,). sample_times_us: (N,) microseconds.
    Raises InputError if the tables are inconsistent.
    """
    path = tables / "sample_annotation.json"
    names = _Names(tables, dialect)
    columns = _joined([_columns(batch, path, names) for batch in (read_batches(path) if path.is_file() else [[]])])
    samples = places_of(columns.pop("samples"), sample_tokens, tables / "sample.json")
    own, times_us = columns.pop("tokens"), sample_times_us[samples]
    first, last = (_linked(columns.pop(name), own, path) for name in ("prev", "next"))
    seconds = (times_us - times_us[:1]).astype(np.float64) * 1e-6
    columns["velocities"] = velocities_between(columns["centers"], seconds, first, last)[:, :2]
    order = np.argsort(samples, kind="stable")
    return Annotations(**_rows(columns, order)), _starts(samples[order], len(sample_tokens))


def _linked(wanted: NDArray[np.bytes_], own: NDArray[np.bytes_], path: Path) -> Ints:
    """(A,) rows of the annotations with the wanted tokens (A,); the own row for an empty one. own: (A,) tokens."""
    rows, stated = np.arange(len(own)), wanted != b""
    rows[stated] = places_of(wanted[stated], own, path)
    return rows


class _Names:
    """The names behind the tokens in an annotation."""

    def __init__(self, tables: Path, dialect: Dialect) -> None:
        categories = _optional(tables / "category.json", "name")
        path = tables / "instance.json"
        owners = _optional(path, "category_token")
        for token in owners.values():
            if token not in categories:
                raise InputError(f'{path}: category "{token}" is missing in category.json')
        self.category = {token: categories[owner].encode() for token, owner in owners.items()}
        attributes = _optional(tables / "attribute.json", "name") if dialect.has_attributes else {}
        self.attribute = {token: name.encode() for token, name in attributes.items()}
        self.visibility = {
            token: dialect.visibilities.get(level) or _middle(level, tables)
            for token, level in _optional(tables / "visibility.json", "level").items()
        }


def _optional(path: Path, name: str) -> dict[str, str]:
    return by_token(path, name) if path.is_file() else {}


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
        "categories": np.array([names.category.get(token, b"") for token in instances], dtype="S"),
        "attributes": np.array([names.attribute.get(own[0], b"") if own else b"" for own in attributes], dtype="S"),
        "instances": tokens(rows, "instance_token", path),
        "centers": vectors(rows, "translation", path, 3),
        "sizes_wlh": vectors(rows, "size", path, 3),
        "quaternions": quaternions(rows, "rotation", path),
        "visibilities": np.array([names.visibility.get(token, np.nan) for token in visibilities]),
        "num_points": integers(rows, "num_lidar_pts", path) + integers(rows, "num_radar_pts", path),
    }
