"""Builds a NuScenesIndex from nuScenes' JSON tables: joins them by token and sorts rows by scene and time."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.geometry.transforms import Array
from bevcli.sequences.garbage_collection import without_garbage_collection
from bevcli.sequences.nuscenes.annotations import read_annotations
from bevcli.sequences.nuscenes.index import Images, Ints, NuScenesIndex, Samples, Scenes, Sensors
from bevcli.sequences.nuscenes.json_tables import (
    Row,
    array_of,
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

LIDAR = "LIDAR_TOP"  # the published models predict in the frame of this sensor


@dataclass(frozen=True)
class _SensorData:
    """Columns of sample_data.json for images, and for LIDAR_TOP at keyframes. Samples and sensors are rows."""

    samples: Ints
    sensors: Ints
    poses: NDArray[np.bytes_]
    times_us: Ints
    keys: NDArray[np.bool_]
    sizes: Ints
    files: NDArray[np.bytes_]

    def __getitem__(self, rows: NDArray) -> _SensorData:
        return _SensorData(**{name: values[rows] for name, values in vars(self).items()})


def build_index(tables: Path) -> NuScenesIndex:
    """Read the folder with one version's tables. Raises InputError if one is missing, invalid or inconsistent."""
    with without_garbage_collection():
        sensor_tokens, sensors = _read_sensors(tables)
        names, sample_tokens, sample_times, sample_scenes = _read_samples(tables)
        data = _read_sensor_data(tables, sample_tokens, sensor_tokens, sensors)
        translations, quaternions = _read_poses(tables, data.poses)
        lidar = sensors.channels[data.sensors] == LIDAR
        lidar_rows = _lidar_of_samples(tables, data.samples, np.flatnonzero(lidar), len(sample_tokens), sample_tokens)
        image_rows = _by_scene_and_time(data, ~lidar, sample_scenes)
        annotations, first_annotation = read_annotations(tables, sample_tokens, sample_times)
    images = data[image_rows]
    return NuScenesIndex(
        Scenes(
            names,
            _starts(sample_scenes, len(names)),
            _starts(sample_scenes[images.samples], len(names)),
        ),
        sensors,
        Samples(
            sample_tokens,
            sample_times,
            translations[lidar_rows],
            quaternions[lidar_rows],
            data.sensors[lidar_rows],
            first_annotation,
        ),
        Images(
            images.samples,
            images.sensors,
            images.times_us,
            images.keys,
            images.sizes,
            translations[image_rows],
            quaternions[image_rows],
            images.files,
        ),
        annotations,
    )


def _read_sensors(tables: Path) -> tuple[NDArray[np.bytes_], Sensors]:
    path = tables / "calibrated_sensor.json"
    sensor_path = tables / "sensor.json"
    sensor_rows = read_rows(sensor_path)
    names = texts(sensor_rows, "channel", sensor_path)
    channels = dict(zip(texts(sensor_rows, "token", sensor_path), names, strict=True))
    rows = read_rows(path)
    sensors = Sensors(
        np.array([channels.get(token, "") for token in texts(rows, "sensor_token", path)], dtype=np.str_),
        vectors(rows, "translation", path, 3),
        quaternions(rows, "rotation", path),
        np.array([_intrinsics(row, path) for row in rows], dtype=np.float64).reshape(-1, 3, 3),
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
    tables: Path, sample_tokens: NDArray[np.bytes_], sensor_tokens: NDArray[np.bytes_], sensors: Sensors
) -> _SensorData:
    path = tables / "sample_data.json"
    lidars = {token.decode() for token in sensor_tokens[sensors.channels == LIDAR]}
    cameras = {token.decode() for token in sensor_tokens[np.isfinite(sensors.intrinsics).all((1, 2))]}
    parts = []
    for batch in read_batches(path):
        owners, keys = texts(batch, "calibrated_sensor_token", path), column(batch, "is_key_frame", path)
        needed = [
            row
            for row, owner, key in zip(batch, owners, keys, strict=True)
            if owner in cameras or (key and owner in lidars)
        ]
        if needed:
            parts.append(_sensor_data_of(needed, path, sample_tokens, sensor_tokens))
    if not parts:
        raise InputError(f"{path}: no row belongs to a camera (expected camera images)")
    return _SensorData(**{name: np.concatenate([vars(part)[name] for part in parts]) for name in vars(parts[0])})


def _sensor_data_of(
    rows: list[Row], path: Path, sample_tokens: NDArray[np.bytes_], sensor_tokens: NDArray[np.bytes_]
) -> _SensorData:
    return _SensorData(
        samples=places_of(tokens(rows, "sample_token", path), sample_tokens, path.with_name("sample.json")),
        sensors=places_of(
            tokens(rows, "calibrated_sensor_token", path), sensor_tokens, path.with_name("calibrated_sensor.json")
        ),
        poses=tokens(rows, "ego_pose_token", path),
        times_us=integers(rows, "timestamp", path),
        keys=integers(rows, "is_key_frame", path).astype(bool),
        sizes=np.stack([integers(rows, "width", path), integers(rows, "height", path)], axis=1),
        files=np.array([name.encode("utf-8", "surrogatepass") for name in texts(rows, "filename", path)]),
    )


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
    tables: Path, samples: Ints, lidar_rows: Ints, count: int, sample_tokens: NDArray[np.bytes_]
) -> Ints:
    """(N,) the row of each sample's LIDAR_TOP keyframe."""
    rows = np.full(count, -1, dtype=np.int64)
    rows[samples[lidar_rows]] = lidar_rows
    if (rows < 0).any():
        token = sample_tokens[rows < 0][0].decode()
        raise InputError(f'{tables / "sample_data.json"}: sample "{token}" has no keyframe of {LIDAR}')
    return rows


def _by_scene_and_time(data: _SensorData, chosen: NDArray[np.bool_], sample_scenes: Ints) -> Ints:
    rows = np.flatnonzero(chosen)
    return rows[np.lexsort((data.times_us[rows], sample_scenes[data.samples[rows]]))]


def _starts(sorted_owners: Ints, count: int) -> Ints:
    """(count + 1,) the first row of each owner."""
    return np.searchsorted(sorted_owners, np.arange(count + 1))
