"""Cases of recordings that another program wrote or changed: other columns, chunks in another order, cut anywhere."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from random import Random

import numpy as np
import pyarrow as pa
from memory_drive import MemoryDrive, make_rig
from recorded_drive import record
from rerun.chunk import Chunk, LazyChunkStream, RrdReader

from bevcli.recording import entities
from bevcli.sequences.files.boxes_file import write_boxes
from bevcli.viewer.recording_file import open_recording
from bevcli.viewer.recording_reader import RecordingReader, read_recording, summarise
from bevcli.workshop.video.video import RecordedImages, draw_frame, frame_rate, tiles

READ = (entities.WORLD, entities.EGO, entities.BOXES, entities.RUN, entities.SPEED, "world/cameras", "bev")


def foreign_columns(seeds: Path, case: Path, random: Random) -> None:
    """A recording with other types, lengths or numbers is refused, or read into finite boxes and images."""
    chunks = list(RrdReader(_recorded(seeds)).stream())
    read = [place for place, chunk in enumerate(chunks) if chunk.entity_path.strip("/").startswith(READ)]
    for _ in range(random.choice((1, 1, 2, 4))):
        place = random.choice(read)
        chunks[place] = _changed(chunks[place], random)
    _write(case / "r.rrd", [chunk for chunk in chunks if chunk is not None])
    frames = _read(case / "r.rrd")
    assert all(np.isfinite(box["center"]).all() for frame in frames for box in frame["boxes"])


def reordered_recording(seeds: Path, case: Path, random: Random) -> None:
    """A recording whose chunks are in another order, or split by columns, has the same boxes."""
    chunks = [part for chunk in RrdReader(_recorded(seeds)).stream() for part in _split(chunk, random)]
    random.shuffle(chunks)
    _write(case / "r.rrd", chunks)
    assert _read(case / "r.rrd") == _read(_recorded(seeds))


def cut_recording(seeds: Path, case: Path, random: Random) -> None:
    """A recording that is cut anywhere is refused, or has some of the frames, each as it was."""
    content = _recorded(seeds).read_bytes()
    (case / "r.rrd").write_bytes(content[: random.randrange(len(content))])
    whole = _read(_recorded(seeds))
    assert all(frame in whole for frame in _read(case / "r.rrd"))


@cache
def _recorded(seeds: Path) -> Path:
    path = seeds / "frames.rrd"
    if not path.exists():
        record(path, MemoryDrive(3, make_rig({"CAM_FRONT": 0.0})))
    return path


def _read(path: Path) -> list[dict]:
    """The frames of the boxes file that is exported, after all else that reads a recording has read it."""
    out = path.with_name("boxes.json")
    with open_recording(path) as file:
        try:
            write_boxes(read_recording(file), out)
            summarise(path, file)
        finally:
            frame_rate(file)
            images = RecordedImages()
            for frame in RecordingReader(file).frames():
                draw_frame(frame, tiles(frame), images)
    return json.loads(out.read_bytes())["frames"]


def _write(path: Path, chunks: list[Chunk]) -> None:
    LazyChunkStream.from_iter(chunks).write_rrd(path, application_id="bevcli", recording_id="other")


def _changed(chunk: Chunk | None, random: Random) -> Chunk | None:
    """The chunk with another column, or without one; None in place of it."""
    if chunk is None or random.random() < 0.1:
        return None
    batch = chunk.to_record_batch()
    places = [i for i, field in enumerate(batch.schema) if (field.metadata or {}).get(b"rerun:kind") == b"data"]
    if not places:
        return chunk
    place = random.choice(places)
    field = batch.schema.field(place)
    if random.random() < 0.2:
        batch = batch.remove_column(place)
    else:
        made = _column(batch.column(place), random)
        batch = batch.set_column(place, pa.field(field.name, made.type, metadata=field.metadata), made)
    try:
        return Chunk.from_record_batch(batch)[0]
    except ValueError:
        return chunk


def _column(column: pa.Array, random: Random) -> pa.Array:
    """A column of lists, one for each row, of another type, of other lengths or with other numbers."""
    if random.random() < 0.5 and len(column) == 1 and column[0].is_valid and _is_float(column.type):
        flat, bad = column, random.choice((np.nan, np.inf, -np.inf, 0.0, -1.0, 1e30, 3e38))
        numbers = np.array(_flat(flat).to_numpy(zero_copy_only=False))
        numbers[random.randrange(max(1, len(numbers))) :] = bad
        return _like(column.type, numbers)
    value = random.choice(VALUES)
    return pa.array([value] * len(column)) if not isinstance(value, pa.Array) else pa.array(
        [value.to_pylist()] * len(column), pa.list_(value.type)
    )  # fmt: skip


def _is_float(kind: pa.DataType) -> bool:
    while pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind):
        kind = kind.value_type
    return pa.types.is_floating(kind)


def _flat(column: pa.Array) -> pa.Array:
    while pa.types.is_list(column.type) or pa.types.is_fixed_size_list(column.type):
        column = column.flatten()
    return column


def _like(kind: pa.DataType, numbers: np.ndarray) -> pa.Array:
    """All numbers as the only row of a column."""
    inner, values = kind.value_type, pa.array(numbers, _flat_type(kind))
    if pa.types.is_fixed_size_list(inner):
        values = pa.FixedSizeListArray.from_arrays(values, inner.list_size)
    elif pa.types.is_list(inner):
        points = pa.FixedSizeListArray.from_arrays(values, inner.value_type.list_size)
        values = pa.ListArray.from_arrays(pa.array([0, len(points)], pa.int32()), points)
    return pa.ListArray.from_arrays(pa.array([0, len(values)], pa.int32()), values)


def _flat_type(kind: pa.DataType) -> pa.DataType:
    while pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind):
        kind = kind.value_type
    return kind


POINTS = pa.list_(pa.float32(), 2)
VALUES = (
    pa.array([], pa.float32()), pa.array([1.0]), pa.array([1, 2]), pa.array([-1]), pa.array([2**64 - 1], pa.uint64()),
    pa.array([None], pa.float64()), pa.array([None, "car"], pa.utf8()), pa.array(["car"]), pa.array(["日本", ""]),
    pa.array([b"\xff"]), pa.array([True]), pa.array([2**62], pa.int64()), pa.array([-(2**63)], pa.int64()),
    pa.array([10**18], pa.timestamp("ns")), pa.array([{"height": 3, "width": -1}]), pa.array([{"x": 1.0}]),
    pa.array([[1.0, 2.0]], POINTS), pa.array([[[0.0, 0.0], [1e30, 1.0]], []], pa.list_(POINTS)),
    pa.array([[]], pa.list_(POINTS)), pa.array([[1.0], [2.0]]), pa.array([np.float16(1)]), pa.array(["#ff9e2c", "#zz"]),
    pa.array(["x" * 5000] * 50), pa.array([0] * 100, pa.uint8()), pa.array(["CAM_FRONT"] * 40), pa.nulls(2),
)  # fmt: skip


def _split(chunk: Chunk, random: Random) -> list[Chunk]:
    """The chunk, or two with the same rows and each other's columns left out, as `rerun rrd optimize` makes them."""
    batch = chunk.to_record_batch()
    places = [i for i, field in enumerate(batch.schema) if (field.metadata or {}).get(b"rerun:kind") == b"data"]
    if len(places) < 2 or random.random() < 0.5:
        return [chunk]
    other = set(random.sample(places, len(places) // 2))
    kept = [[i for i in range(batch.num_columns) if i not in part] for part in (other, set(places) - other)]
    parts = [batch.select(columns) for columns in kept]
    metadata = {key: value for key, value in (batch.schema.metadata or {}).items() if key != b"rerun:id"}
    stem = batch.schema.metadata[b"rerun:id"].decode()[:-10]
    second = parts[1].replace_schema_metadata({**metadata, b"rerun:id": f"{stem}{random.getrandbits(40):010x}"})
    return [*Chunk.from_record_batch(parts[0]), *Chunk.from_record_batch(second)]
