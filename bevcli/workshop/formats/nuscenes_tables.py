"""nuScenes' JSON tables -> NuScenesIndex: joins them by token, sorts rows by scene and time, and caches the index.

Large tables, some over a gigabyte, are read in batches, and their index is cached: memory-mapped arrays that open
almost at once. The cache is in $XDG_CACHE_HOME/bevcli/nuscenes (default ~/.cache/bevcli/nuscenes), never in the
dataset, with one folder for each version's path. The index is rebuilt if the size or modification time of a table has
changed, or a file of the cache is missing or damaged. Small versions are not cached.
"""

import hashlib
import json
import os
import re
import shutil
import zlib
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, fields
from itertools import compress
from pathlib import Path
from typing import Any, TypeAlias, get_type_hints

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.geometry.ego_motion import nearest
from bevcli.geometry.transforms import Array
from bevcli.parsing.documents import LARGEST_INTEGER, parse_json, without_garbage_collection
from bevcli.parsing.files import open_regular, read_bytes
from bevcli.workshop.formats.nuscenes_index import (
    NUSCENES,
    Annotations,
    Dialect,
    Images,
    Ints,
    NuScenesIndex,
    Samples,
    Scenes,
    Sensors,
)
from bevcli.writing import UNFINISHED, remove_abandoned, remove_parts, user_cache

Row: TypeAlias = dict[str, Any]
BATCH_BYTES = 16 << 20
LONGEST_TEXT = 400  # characters of a token, name or path
LARGEST_NUMBER = 1e12  # metres or pixels
SHORTEST_QUATERNION = 1e-3
MAX_GAP_S = 1.5  # longest time between two annotations of an object from which a velocity is derived
# The text between two rows. Rows of large tables contain no objects and no free text, so it occurs nowhere else.
BETWEEN_ROWS = re.compile(rb"}\s*,\s*{")
TAIL_BYTES = 1 << 14  # the end of a batch in which its last complete row ends; no row is longer
Columns = dict[str, NDArray]  # the columns of a table by name, as many rows each
CACHE_FORMAT = 2  # version of the cached arrays; increase it when the index changes
SMALLEST_BYTES = 64 << 20  # smaller tables are not cached, because reading them takes a second or two
FINGERPRINT = "fingerprint.json"


@dataclass(frozen=True)
class Rows:
    """Rows of a table. Its columns are checked when they are asked for: each method raises InputError for wrong values.

    path: of the table, for messages.
    """

    path: Path
    rows: list[Row]

    def __len__(self) -> int:
        return len(self.rows)

    def where(self, kept: Iterable[object]) -> "Rows":
        """Some of the rows. kept: a value for each row, which is true for those."""
        return Rows(self.path, list(compress(self.rows, kept)))

    def column(self, name: str) -> list[Any]:
        """The values of a column, which every row must have."""
        try:
            return [row[name] for row in self.rows]
        except (KeyError, TypeError):
            raise self._error(f'a row has no "{name}" (expected a nuScenes table)') from None

    def integers(self, name: str) -> NDArray[np.int64]:
        """(N,) int64 values of a column."""
        values = self.column(name)
        if not set(map(type, values)) <= {int, bool} or max(map(abs, values), default=0) > LARGEST_INTEGER // 1000:
            wrong = next(
                value for value in values if type(value) not in (int, bool) or abs(value) > LARGEST_INTEGER // 1000
            )
            unit = ": give microseconds, not seconds" if type(wrong) is float and 1e8 < wrong < 1e11 else ""
            raise self._error(
                f'"{name}": expected an integer of at most 52 bits in every row, found {wrong!r:.40}{unit}'
            )
        return np.array(values, dtype=np.int64)

    def vectors(self, name: str, size: int) -> Array:
        """(N, size) finite values of a column of number lists."""
        values = array_of(self.column(name), (len(self), size))
        if values is None:
            raise self._error(f'"{name}": expected {size} finite numbers in every row')
        return values

    def quaternions(self, name: str) -> Array:
        """(N, 4) w, x, y, z of a column, with norms above 0."""
        values = self.vectors(name, 4)
        if not (np.linalg.norm(values, axis=1) > SHORTEST_QUATERNION).all():
            raise self._error(f'"{name}": expected quaternions of norm 1, found one of norm 0')
        return values

    def texts(self, name: str) -> list[str]:
        """The texts of a column, each of at most 400 characters."""
        values = self.column(name)
        if not set(map(type, values)) <= {str} or max(map(len, values), default=0) > LONGEST_TEXT:
            raise self._error(f'"{name}": expected a text of at most {LONGEST_TEXT} characters in every row')
        return values

    def by_token(self, name: str) -> dict[str, str]:
        """The texts of a column by the token of their row."""
        return dict(zip(self.texts("token"), self.texts(name), strict=True))

    def tokens(self, name: str) -> NDArray[np.bytes_]:
        """(N,) tokens of a column, ASCII texts, as bytes."""
        try:
            return np.array(self.texts(name), dtype="S") if self.rows else np.zeros(0, dtype="S32")
        except UnicodeEncodeError:
            raise self._error(f'"{name}": expected a token of ASCII characters in every row') from None

    def _error(self, problem: str) -> InputError:
        return InputError(f"{self.path}: {problem}")


def read_rows(path: Path) -> Rows:
    """All rows of a table. Raises InputError if it is missing or not a list."""
    return Rows(path, [row for batch in read_batches(path) for row in batch.rows])


def read_batches(path: Path) -> Iterator[Rows]:
    """The rows of a table, tens of thousands at a time. Raises InputError as `read_rows`."""
    if not path.is_file():
        raise InputError(f"{path}: the table is missing (expected a nuScenes table)")
    if path.stat().st_size <= BATCH_BYTES:
        yield _parse(path, read_bytes(path, BATCH_BYTES), keys_checked=True)
        return
    with open_regular(path) as file:
        rest = file.read(BATCH_BYTES).lstrip()[1:]  # without the list's opening bracket
        while block := file.read(BATCH_BYTES):
            text = rest + block
            ends = [match.start() + 1 for match in BETWEEN_ROWS.finditer(text, max(0, len(text) - TAIL_BYTES))]
            cut = ends[-1] if ends else 0
            yield _parse(path, b"[" + text[:cut] + b"]")
            rest = text[cut:].lstrip()[1:]  # without the comma
        yield _parse(path, b"[" + rest)


def array_of(value: Any, shape: tuple[int, ...]) -> Array | None:
    """Nested lists as a float64 array of finite numbers of this shape; None if they are not."""
    try:
        array = np.array(value, dtype=np.float64).reshape(shape if 0 in shape else np.shape(value))
    except (ValueError, TypeError, OverflowError):
        return None
    return array if array.shape == shape and (np.abs(array) < LARGEST_NUMBER).all() else None


def places_of(tokens: NDArray[np.bytes_], table: NDArray[np.bytes_], path: Path) -> NDArray[np.int64]:
    """(N,) rows of the wanted tokens (N,) in a table with the tokens (M,). Raises InputError if one is missing."""
    places, unknown = np.zeros(0, dtype=np.int64), tokens  # of a table without rows
    if len(table):
        order = np.argsort(table)
        places = order[np.searchsorted(table, tokens, sorter=order).clip(max=len(table) - 1)]
        unknown = tokens[table[places] != tokens]
    if len(unknown):
        token = unknown[0].decode()
        raise InputError(f'{path}: token "{token}" is missing in this table, but another table refers to it')
    return places


def _parse(path: Path, text: bytes, *, keys_checked: bool = False) -> Rows:
    rows = parse_json(text, path, keys_checked=keys_checked)
    if not isinstance(rows, list) or not all(type(row) is dict for row in rows):
        raise InputError(f"{path}: expected a list of rows (a nuScenes table)")
    return Rows(path, rows)


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
            pose_rows[sample] = rows[nearest(data["times_us"][rows], sample_times[sample])] if len(rows) else 0
        annotations, first_annotation = _read_annotations(tables, sample_tokens, sample_times, dialect)
    scenes = Scenes(names, _starts(sample_scenes, len(names)), starts)
    translations, quaternions = data["translations"][pose_rows], data["quaternions"][pose_rows]
    lidars = np.where(lidar_rows < 0, -1, data["sensors"][lidar_rows])
    samples = Samples(sample_tokens, sample_times, translations, quaternions, lidars, first_annotation)
    return NuScenesIndex(scenes, sensors, samples, images, annotations)


def _rows(columns: Columns, rows: Ints) -> Columns:
    return {name: values[rows] for name, values in columns.items()}


def _joined(parts: list[Columns]) -> Columns:
    return {name: np.concatenate([columns[name] for columns in parts]) for name in parts[0]}


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
    parts, listed = [], {token.decode() for token in sensor_tokens}
    for batch in read_batches(path):
        sensor_rows = zip(batch.rows, batch.texts("calibrated_sensor_token"), batch.column("is_key_frame"), strict=True)
        needed = batch.where(
            (owner in cameras and row.get("is_valid") is not False)
            or (key and owner in lidars)
            or owner not in listed  # an error, which `places_of` raises
            for row, owner, key in sensor_rows
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


def _read_poses(tables: Path, pose_tokens: NDArray[np.bytes_]) -> tuple[Array, Array]:
    """Translations (P, 3), metres, and quaternions (P, 4) of world_from_ego for the pose tokens (P,)."""
    path = tables / "ego_pose.json"
    needed = {token.decode() for token in pose_tokens}
    parts = []
    for batch in read_batches(path):
        rows = batch.where(token in needed for token in batch.texts("token"))
        parts.append((rows.tokens("token"), rows.vectors("translation", 3), rows.quaternions("rotation")))
    tokens, translations, rotations = map(np.concatenate, zip(*parts, strict=True))
    places = places_of(pose_tokens, tokens, path)
    quaternions = rotations[places]
    return translations[places], quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)


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
    tokens, times_us = columns.pop("tokens"), sample_times_us[samples]
    first, last = (_linked(columns.pop(name), tokens, path) for name in ("prev", "next"))
    seconds = (times_us - times_us[:1]).astype(np.float64) * 1e-6
    columns["velocities"] = velocities_between(columns["centers"], seconds, first, last)[:, :2]
    order = np.argsort(samples, kind="stable")
    return Annotations(**_rows(columns, order)), _starts(samples[order], len(sample_tokens))


def velocities_between(centers: Array, times_s: Array, first: Ints, last: Ints) -> Array:
    """(A, 3) m/s, NaN if unknown: central differences, one-sided for an object's first and last annotation.

    As in the official nuScenes devkit, a velocity is known if each time gap is at most 1.5 s on average.

    centers: (A, 3) metres, world frame. times_s: (A,) seconds. first, last: (A,) rows of the annotations of the same
    object before and after; the own row where there is none.
    """
    rows = np.arange(len(centers))
    seconds = times_s[last] - times_s[first]
    longest = MAX_GAP_S * ((first != rows).astype(int) + (last != rows))
    is_short = (seconds > 0) & (seconds <= longest)
    with np.errstate(divide="ignore", invalid="ignore"):
        velocities: Array = (centers[last] - centers[first]) / seconds[:, None]
    return np.where(is_short[:, None], velocities, np.nan)


def _linked(linked: NDArray[np.bytes_], tokens: NDArray[np.bytes_], path: Path) -> Ints:
    """(A,) rows of the annotations with the wanted tokens (A,); the own row for an empty one. own: (A,) tokens."""
    rows, is_linked = np.arange(len(tokens)), linked != b""
    rows[is_linked] = places_of(linked[is_linked], tokens, path)
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
    match = re.fullmatch(r"v(100|[0-9]{1,2})-(100|[0-9]{1,2})", level)
    return np.nan if match is None else (int(match[1]) + int(match[2])) / 200


def _num_points(rows: Rows) -> Ints:
    """(A,) lidar and radar points; -1 where one of them is null."""
    columns = [rows.column(name) for name in ("num_lidar_pts", "num_radar_pts")]
    has_counts = [None not in counts for counts in zip(*columns, strict=True)]
    points = np.full(len(rows), -1, dtype=np.int64)
    counted = rows.where(has_counts)
    points[has_counts] = counted.integers("num_lidar_pts") + counted.integers("num_radar_pts")
    return points


def _columns(rows: Rows, names: _Names) -> Columns:
    attributes = rows.column("attribute_tokens")
    if not all(type(ids) is list and all(type(token) is str for token in ids) for ids in attributes):
        raise InputError(f'{rows.path}: "attribute_tokens": expected a list of tokens in every row')
    return {
        "tokens": rows.tokens("token"),
        "samples": rows.tokens("sample_token"),
        "prev": rows.tokens("prev"),
        "next": rows.tokens("next"),
        "categories": np.array([names.category.get(token, b"") for token in rows.texts("instance_token")], dtype="S"),
        "attributes": np.array([names.attribute.get(ids[0], b"") if ids else b"" for ids in attributes], dtype="S"),
        "instances": rows.tokens("instance_token"),
        "centers": rows.vectors("translation", 3),
        "sizes_wlh": rows.vectors("size", 3),
        "quaternions": rows.quaternions("rotation"),
        "visibilities": np.array([names.visibility.get(token, np.nan) for token in rows.texts("visibility_token")]),
        "num_points": _num_points(rows),
    }


def open_index(tables: Path, dialect: Dialect = NUSCENES) -> tuple[NuScenesIndex, str]:
    """The index of a folder with tables, from the cache if it is up to date, and a note for the user or ""."""
    if sum(path.stat().st_size for path in tables.glob("*.json")) < SMALLEST_BYTES:
        return build_index(tables, dialect), ""
    name = hashlib.sha256(str(tables.resolve()).encode()).hexdigest()[:16]
    folder = user_cache() / "nuscenes" / f"{tables.name}-{name}"
    states = [(path.name, path.stat().st_size, path.stat().st_mtime_ns) for path in sorted(tables.glob("*.json"))]
    fingerprint = json.dumps({"format": CACHE_FORMAT, "tables": states})
    with suppress(OSError, ValueError, EOFError):  # there is no cache, or it is damaged
        if (folder / FINGERPRINT).read_text(encoding="utf-8") == f"{fingerprint}\n{_checksum(folder)}":
            return _load(folder), ""
    index = build_index(tables, dialect)
    try:
        _save(index, folder, fingerprint)
    except OSError as error:
        return index, f"{folder}: the index cannot be cached ({error.strerror}); opening it again will be slow"
    return index, f"the index of the nuScenes tables is cached in {folder}"


def _save(index: NuScenesIndex, folder: Path, fingerprint: str) -> None:
    """Write to a temporary folder, then rename it, so that an interrupted run leaves no incomplete index."""
    unfinished = folder.with_name(f"{folder.name}{UNFINISHED}{os.getpid()}")
    remove_abandoned(folder.parent, f"{folder.name}{UNFINISHED}")
    unfinished.mkdir(parents=True)
    try:
        for group, table in vars(index).items():
            for name, values in vars(table).items():
                np.save(unfinished / f"{group}.{name}.npy", values, allow_pickle=False)
        (unfinished / FINGERPRINT).write_text(f"{fingerprint}\n{_checksum(unfinished)}", encoding="utf-8")
        remove_parts(folder.parent, [folder.name])
        unfinished.rename(folder)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)  # of a full disk, or where another process was faster


def _checksum(folder: Path) -> int:
    """Of all arrays: a crash or a bad disk may leave other contents of the same size."""
    total = 0
    for path in sorted(folder.glob("*.npy")):
        total = zlib.crc32(np.memmap(path, np.uint8, "r").data, total)
    return total


def _load(folder: Path) -> NuScenesIndex:
    parts: dict[str, Any] = {}
    for name, cls in get_type_hints(NuScenesIndex).items():
        columns = {
            column.name: np.load(folder / f"{name}.{column.name}.npy", mmap_mode="r", allow_pickle=False)
            for column in fields(cls)
        }
        parts[name] = cls(**columns)
    return NuScenesIndex(**parts)
