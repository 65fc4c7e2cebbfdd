"""Builds a NuScenesIndex from nuScenes' JSON tables: joins them by token and sorts rows by scene and time."""

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.geometry.transforms import Array
from bevcli.parsing.documents import without_garbage_collection
from bevcli.sequences.nuscenes.index import Annotations, Dialect, Images, Ints, NuScenesIndex, Samples, Scenes, Sensors
from bevcli.sequences.nuscenes.json_tables import Row, Rows, array_of, places_of, read_batches, read_rows
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
        image_rows = np.flatnonzero(~lidar)
        if not len(image_rows):
            raise InputError(f"{tables / 'sample_data.json'}: no row belongs to a camera (expected camera images)")
        image_rows = image_rows[np.lexsort((data["times_us"][image_rows], sample_scenes[data["samples"][image_rows]]))]
        images = Images(**_rows(data, image_rows))
        starts = _starts(sample_scenes[images.samples], len(names))
        lidar_rows = np.full(len(sample_tokens), -1)
        lidar_rows[data["samples"][lidar]] = np.flatnonzero(lidar)
        pose_rows = lidar_rows.copy()
        for sample in np.flatnonzero(lidar_rows < 0):  # the nearest image; any in a scene without images
            rows = image_rows[slice(*starts[sample_scenes[sample] :][:2])]
            distances = np.abs(data["times_us"][rows] - sample_times[sample])
            pose_rows[sample] = rows[distances.argmin()] if len(rows) else 0
        annotations, first_annotation = _read_annotations(tables, sample_tokens, sample_times, dialect)
    scenes = Scenes(names, _starts(sample_scenes, len(names)), starts)
    translations, quaternions = data["translations"][pose_rows], data["quaternions"][pose_rows]
    lidars = np.where(lidar_rows < 0, -1, data["sensors"][lidar_rows])
    samples = Samples(sample_tokens, sample_times, translations, quaternions, lidars, first_annotation)
    return NuScenesIndex(scenes, sensors, samples, images, annotations)


def _rows(columns: Columns, rows: Ints) -> Columns:
    return {name: values[rows] for name, values in columns.items()}


def _joined(parts: list[Columns]) -> Columns:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _read_sensors(tables: Path) -> tuple[NDArray[np.bytes_], Sensors]:
    channels, table = read_rows(tables / "sensor.json"), read_rows(tables / "calibrated_sensor.json")
    places = places_of(table.tokens("sensor_token"), channels.tokens("token"), channels.path)
    sensors = Sensors(
        np.array(channels.texts("channel"), dtype=np.str_)[places],
        table.vectors("translation", 3),
        table.quaternions("rotation"),
        np.array([_intrinsics(row, table.path) for row in table.rows], dtype=np.float64).reshape(-1, 3, 3),
        np.array([_distortion(row, table.path) for row in table.rows], dtype=np.float64).reshape(-1, 8),
    )
    return table.tokens("token"), sensors


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
    scenes, samples = read_rows(tables / "scene.json"), read_rows(tables / "sample.json")
    for table in (scenes, samples):
        if not len(table):
            raise InputError(f"{table.path}: the table has no rows (expected at least one)")
    in_scene = places_of(samples.tokens("scene_token"), scenes.tokens("token"), scenes.path)
    times = samples.integers("timestamp")
    order = np.lexsort((times, in_scene))
    names = np.array(scenes.texts("name"), dtype=np.str_)
    return names, samples.tokens("token")[order], times[order], in_scene[order]


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
    parts, known = [], {token.decode() for token in sensor_tokens}
    for batch in read_batches(path):
        facts = zip(batch.rows, batch.texts("calibrated_sensor_token"), batch.column("is_key_frame"), strict=True)
        needed = batch.where(
            (owner in cameras and row.get("is_valid") is not False)
            or (key and owner in lidars)
            or owner not in known  # an error, which `places_of` raises
            for row, owner, key in facts
        )
        if len(needed):
            parts.append(_sensor_data_of(needed, sample_tokens, sensor_tokens))
    return _joined(parts or [_sensor_data_of(Rows(path, []), sample_tokens, sensor_tokens)])


def _sensor_data_of(rows: Rows, sample_tokens: NDArray[np.bytes_], sensor_tokens: NDArray[np.bytes_]) -> Columns:
    of_samples, of_sensors = (rows.path.with_name(name) for name in ("sample.json", "calibrated_sensor.json"))
    return {
        "samples": places_of(rows.tokens("sample_token"), sample_tokens, of_samples),
        "sensors": places_of(rows.tokens("calibrated_sensor_token"), sensor_tokens, of_sensors),
        "poses": rows.tokens("ego_pose_token"),
        "times_us": rows.integers("timestamp"),
        "keys": rows.integers("is_key_frame").astype(bool),
        "sizes": np.stack([rows.integers("width"), rows.integers("height")], axis=1),
        "files": np.array([name.encode("utf-8", "surrogatepass") for name in rows.texts("filename")]),
    }


def _read_poses(tables: Path, wanted: NDArray[np.bytes_]) -> tuple[Array, Array]:
    """Translations (P, 3), metres, and quaternions (P, 4) of world_from_ego for the pose tokens (P,)."""
    path = tables / "ego_pose.json"
    needed = {token.decode() for token in wanted}
    parts = []
    for batch in read_batches(path):
        rows = batch.where(token in needed for token in batch.texts("token"))
        parts.append((rows.tokens("token"), rows.vectors("translation", 3), rows.quaternions("rotation")))
    found, translations, rotations = map(np.concatenate, zip(*parts, strict=True))
    places = places_of(wanted, found, path)
    chosen = rotations[places]
    return translations[places], chosen / np.linalg.norm(chosen, axis=1, keepdims=True)


def _starts(sorted_owners: Ints, count: int) -> Ints:
    """(count + 1,) the first row of each owner."""
    return np.searchsorted(sorted_owners, np.arange(count + 1))


def _read_annotations(
    tables: Path, sample_tokens: NDArray[np.bytes_], sample_times_us: Ints, dialect: Dialect
) -> tuple[Annotations, Ints]:
    """The annotations ordered by sample, none without a table, and the row of each sample's first one (N + 1,)."""
    path = tables / "sample_annotation.json"
    names = _Names(tables, dialect)
    batches = read_batches(path) if path.is_file() else [Rows(path, [])]
    columns = _joined([_columns(batch, names) for batch in batches])
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
            token: dialect.visibilities.get(level) or _middle(level)
            for token, level in _optional(tables / "visibility.json", "level").items()
        }


def _optional(path: Path, name: str) -> dict[str, str]:
    return read_rows(path).by_token(name) if path.is_file() else {}


def _middle(level: str) -> float:
    """The middle of a visibility level such as "v40-60", as a fraction from 0 to 1; NaN for other levels."""
    found = re.fullmatch(r"v(100|[0-9]{1,2})-(100|[0-9]{1,2})", level)
    return np.nan if found is None else (int(found[1]) + int(found[2])) / 200


def _num_points(rows: Rows) -> Ints:
    """(A,) lidar and radar points; -1 where one of them is null."""
    columns = [rows.column(name) for name in ("num_lidar_pts", "num_radar_pts")]
    known = [None not in counts for counts in zip(*columns, strict=True)]
    found = np.full(len(rows), -1, dtype=np.int64)
    some = rows.where(known)
    found[known] = some.integers("num_lidar_pts") + some.integers("num_radar_pts")
    return found


def _columns(rows: Rows, names: _Names) -> Columns:
    attributes = rows.column("attribute_tokens")
    if not all(type(own) is list and all(type(token) is str for token in own) for own in attributes):
        raise InputError(f'{rows.path}: "attribute_tokens": expected a list of tokens in every row')
    return {
        "tokens": rows.tokens("token"),
        "samples": rows.tokens("sample_token"),
        "prev": rows.tokens("prev"),
        "next": rows.tokens("next"),
        "categories": np.array([names.category.get(token, b"") for token in rows.texts("instance_token")], dtype="S"),
        "attributes": np.array([names.attribute.get(own[0], b"") if own else b"" for own in attributes], dtype="S"),
        "instances": rows.tokens("instance_token"),
        "centers": rows.vectors("translation", 3),
        "sizes_wlh": rows.vectors("size", 3),
        "quaternions": rows.quaternions("rotation"),
        "visibilities": np.array([names.visibility.get(token, np.nan) for token in rows.texts("visibility_token")]),
        "num_points": _num_points(rows),
    }
