"""Reads a recording frame by frame, with as few frames in memory as the file's order allows; boxes; the summary."""

import warnings
from bisect import bisect
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from rerun.chunk import Chunk, RrdReader

from bevcli.errors import InputError
from bevcli.frame import FrameStamp
from bevcli.geometry.boxes import OPTIONAL_COLUMNS, Boxes3D, Column
from bevcli.geometry.transforms import Array, Pose
from bevcli.printing import counted
from bevcli.recording import entities
from bevcli.sequences.files.boxes_file import FrameBoxes

Row = dict[str, pa.Scalar]


Logged = tuple[bytes, str, Row]  # the row's identity, which grows with the time of logging; its entity; its components
OF_EACH_FRAME = (entities.EGO, entities.BOXES)  # never those of an earlier frame
NO_FRAME = np.inf  # after all frames
MOST_SKEW = 1e-3  # of a rotation: difference of R Rᵀ and the identity
SHOWN_ENTITIES = 15


@dataclass(frozen=True)
class RecordedFrame:
    """The state of all entities at one frame. What is read is checked: InputError for other types and lengths."""

    index: int  # the frame's index
    rows: Mapping[str, Row]  # by entity, then by component: the newest value, static ones included
    path: Path  # the recording's file, for messages

    def has(self, entity: str, component: str) -> bool:
        """True if the entity has a value for this component."""
        return component in self.rows.get(entity, {}) and self.rows[entity][component].is_valid

    def values(self, entity: str, component: str) -> list[Any]:
        """The values of a component as Python objects; [] if there are none."""
        try:
            return self.rows[entity][component].as_py() if self.has(entity, component) else []
        except (ValueError, OverflowError) as error:  # such as bytes that are no text, or times that Python lacks
            raise self.wrong(entity, component, "values that can be read", error) from None

    def texts(self, entity: str, component: str, count: int | None = None) -> list[str]:
        """The values of a component that are texts; [] if there are none. count: as of `array`."""
        values = self.values(entity, component)
        if not all(isinstance(value, str) for value in values) or count not in (None, len(values)):
            raise self.wrong(entity, component, "texts", values, count)
        return values

    def integers(self, entity: str, component: str, count: int | None = None) -> list[int]:
        """The values of a component that are integers of 64 bits or booleans; [] if there are none. count: as above."""
        values = self.values(entity, component)
        whole = all(isinstance(value, int) and -(1 << 63) <= value < 1 << 63 for value in values)
        if not whole or count not in (None, len(values)):
            raise self.wrong(entity, component, "integers of 64 bits", values, count)
        return values

    def array(self, entity: str, component: str, width: int, count: int | None = None, *, nan: bool = False) -> Array:
        """The values of a component as (N, width) float64, `width` numbers each; (0, width) if there are none.

        count: the N that is expected, if any is. nan: NaN, for a number that is not known, may be among them.
        """
        flat = self._flat(entity, component, width)
        is_numeric = pa.types.is_integer(flat.type) or pa.types.is_floating(flat.type)
        values = np.asarray(flat.to_numpy(zero_copy_only=False), dtype=np.float64) if is_numeric else np.zeros(1)
        if not is_numeric or len(values) % width or count not in (None, len(values) // width):
            raise self.wrong(entity, component, f"values of {width} numbers", flat, count)
        if not (np.isfinite(values) | (nan & np.isnan(values))).all():
            raise self.wrong(entity, component, "finite numbers", "NaN or infinity")
        return values.reshape(-1, width)

    def strips(self, entity: str, component: str) -> list[Array]:
        """The values of a component that are lists of points, (P, 2) each."""
        if not self.has(entity, component):
            return []
        lists, points = self.rows[entity][component].values, self.array(entity, component, 2)
        ends = np.cumsum(lists.value_lengths().to_numpy(zero_copy_only=False)) if pa.types.is_list(lists.type) else [-1]
        if len(ends) and ends[-1] != len(points):
            raise self.wrong(entity, component, "lists of points (x, y)", lists.type)
        return np.split(points, ends[:-1])[: len(ends)]

    def blob(self, entity: str, component: str) -> bytes:
        """The bytes of a component that is one blob, such as a JPEG; empty if there is none."""
        flat = self._flat(entity, component)
        if flat.type != pa.uint8() or flat.null_count:
            raise self.wrong(entity, component, "bytes", flat.type)
        return flat.to_numpy().tobytes()

    def wrong(self, entity: str, component: str, expected: str, found: object, count: int | None = None) -> InputError:
        """The error of a component whose values are not the expected ones, or not as many as the `count`."""
        expected = expected if count is None else f"{count} {expected}"
        found = f"{len(found)} of type {found.type}" if isinstance(found, pa.Array) else f"{found!s:.40}"
        return InputError(
            f"{self.path}: frame {self.index}: {entity}: {component}: expected {expected}, found {found}: "
            "is it a recording of `bevcli run`?"
        )

    def _flat(self, entity: str, component: str, width: int = 1) -> pa.Array:
        if not self.has(entity, component):
            return pa.array([], pa.uint8())
        values = self.rows[entity][component].values
        while pa.types.is_list(values.type) or pa.types.is_fixed_size_list(values.type):
            if pa.types.is_fixed_size_list(values.type) and values.type.list_size != width:
                raise self.wrong(entity, component, f"{width} numbers in each value", values)
            values = values.flatten()
        return values


class RecordingReader:
    """A recording that `Recording` wrote. Raises InputError if the file cannot be read or holds several recordings.

    Attributes:
        left_out: frames without their vehicle or boxes, of the last call of `frames`.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.left_out = path, 0
        with self._reading():
            self._reader = RrdReader(path)
            count = len(self._reader.recordings())
        if count != 1:
            raise InputError(f"{self.path}: the file holds {count} recordings (expected one of `bevcli run`)")

    @contextmanager
    def _reading(self) -> Iterator[None]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # rerun warns that a file without its end is read in parts; all are
            try:
                yield
            except (RuntimeError, ValueError) as error:
                raise InputError(f"{self.path}: the recording cannot be read ({error})") from error

    def chunks(self) -> Iterator[Chunk]:
        """All chunks of the recording, in the order of the file."""
        with self._reading():
            yield from self._reader.stream()

    def frames(self) -> Iterator[RecordedFrame]:
        """The frames in order, each with the state of all entities.

        A frame without its vehicle or its boxes is left out: the file is cut or damaged, or another program wrote it.
        """
        self.left_out = 0
        still: list[Logged] = []
        firsts: list[float] = []
        for chunk in self.chunks():
            firsts.append(min(self._frames_of(chunk), default=NO_FRAME))
            still += _rows(chunk) if chunk.is_static else ()
        static = _applied({}, still)
        later = [*accumulate(reversed(firsts), min, initial=NO_FRAME)][-2::-1]  # the first frame behind each chunk
        state, waiting = static, defaultdict[int, list[Logged]](list)
        for first_later, chunk in zip(later, self.chunks(), strict=False):  # a run that is going on adds chunks
            for frame, row in zip(self._frames_of(chunk), _rows(chunk), strict=False):
                waiting[frame].append(row)
            for frame in sorted(frame for frame in waiting if frame < first_later):
                rows = waiting.pop(frame)
                state = _applied(state | {entity: static.get(entity, {}) for entity in OF_EACH_FRAME}, rows)
                if {entity for _, entity, _ in rows}.issuperset(OF_EACH_FRAME):
                    yield RecordedFrame(frame, state, self.path)
                else:
                    self.left_out += 1

    def is_of_a_run(self) -> bool:
        """True if it has a vehicle and boxes. What is behind their first rows is not read."""
        wanted = set(OF_EACH_FRAME)
        for chunk in self.chunks():
            wanted.discard(chunk.entity_path.strip("/"))
            if not wanted:
                return True
        return False

    def check_frame(self, index: int) -> None:
        """Raise InputError, which names the nearest frames, if the recording does not have a frame."""
        vehicle = (chunk for chunk in self.chunks() if chunk.entity_path.strip("/") == entities.EGO)
        frames = sorted({frame for chunk in vehicle for frame in self._frames_of(chunk)})
        if frames and index not in frames:
            place = bisect(frames, index)
            near = " and ".join(map(str, frames[max(place - 1, 0) : place + 1]))
            raise InputError(
                f"{self.path}: `frame={index}` (`--frame {index}`): the recording has {counted(len(frames), 'frames')} "
                f"from {frames[0]} to {frames[-1]}, and not this one (nearest: {near})"
            )

    def _frames_of(self, chunk: Chunk) -> list[int]:
        """The frame of each row; [] where the rows are of no frame. Raises InputError for times in place of frames."""
        if entities.FRAME_TIMELINE not in chunk.timeline_names:
            return []
        frames = chunk.to_record_batch().column(entities.FRAME_TIMELINE)
        if frames.type != pa.int64():
            raise InputError(
                f'{self.path}: the timeline "{entities.FRAME_TIMELINE}" holds {frames.type} (expected the numbers of '
                "frames): is it a recording of `bevcli run`?"
            )
        return frames.to_pylist()


def _rows(chunk: Chunk) -> Iterator[Logged]:
    batch, entity = chunk.to_record_batch(), chunk.entity_path.strip("/")
    names = [field.name for field in batch.schema if (field.metadata or {}).get(b"rerun:kind") == b"data"]
    for i in range(batch.num_rows):
        yield batch.column(0)[i].as_py(), entity, {name: batch.column(name)[i] for name in names}


def _applied(state: Mapping[str, Row], rows: list[Logged]) -> dict[str, Row]:
    """The state after rows, which are taken in the order of logging."""
    state = dict(state)
    for _, entity, row in sorted(rows, key=lambda row: row[0]):
        if "Clear:is_recursive" in row:
            state.pop(entity, None)
        else:
            state[entity] = {**state.get(entity, {}), **{n: value for n, value in row.items() if value.is_valid}}
    return state


def recorded_boxes(frame: RecordedFrame) -> FrameBoxes:
    """The shown boxes of a frame in the sequence's world frame, highest score first; recordings store float32."""
    entity, world = entities.BOXES, frame.array(entities.WORLD, "origin", 3)
    origin = world[0] if len(world) else np.zeros(3)
    centers = frame.array(entity, "Boxes3D:centers", 3)
    count = len(centers)
    quaternions = frame.array(entity, "Boxes3D:quaternions", 4, count)  # x, y, z, w
    boxes = Boxes3D(
        centers=centers + origin,
        sizes_lwh=2 * frame.array(entity, "Boxes3D:half_sizes", 3, count),
        yaws=2 * np.arctan2(quaternions[:, 2], quaternions[:, 3]),
        velocities=np.hstack([frame.array(entity, f"velocity_{axis}", 1, count, nan=True) for axis in "xy"]),
        classes=np.array(frame.texts(entity, "name", count), dtype=np.str_),
        **{name: _column(frame, column, count) for name, column in OPTIONAL_COLUMNS.items() if column.recorded},
    )
    if (boxes.sizes_lwh <= 0).any():
        raise frame.wrong(entity, "Boxes3D:half_sizes", "sizes above 0", boxes.sizes_lwh.min() / 2)
    (time,) = frame.integers(entities.EGO, "timestamp_ns", 1)
    stamp = FrameStamp(frame.index, "".join(frame.texts(entities.EGO, "scene")), time)
    world_from_ego = frame.array(entities.EGO, "pose", 16, 1).reshape(4, 4).copy()
    if abs(world_from_ego[:3, :3] @ world_from_ego[:3, :3].T - np.eye(3)).max() > MOST_SKEW:
        raise frame.wrong(entities.EGO, "pose", "a rotation and a place", "another matrix")
    world_from_ego[:3, 3] += origin
    return FrameBoxes(stamp, Pose.from_matrix(world_from_ego), boxes)


def _column(frame: RecordedFrame, column: Column, count: int) -> Any:
    """An optional column of the boxes; None where the recording does not have it."""
    if not frame.has(entities.BOXES, column.recorded) and column.values != "score":
        return None
    if column.values == "text":
        return np.array(frame.texts(entities.BOXES, column.recorded, count), dtype=np.str_)
    values = frame.array(entities.BOXES, column.recorded, 1, count)[:, 0]
    return values.astype({"flag": bool, "count": np.int64}.get(column.values, np.float64))


def summarise(path: Path, read_from: Path | None = None) -> str:
    """The summary of a recording for a terminal: frames, time span, shown boxes by class, sizes by entity.

    read_from: the repaired copy of the recording, if there is one.
    """
    reader = RecordingReader(path if read_from is None else read_from)
    sizes: Counter[str] = Counter()  # in memory
    for chunk in reader.chunks():
        sizes[chunk.entity_path] += chunk.to_record_batch().nbytes
    boxes: Counter[str] = Counter()
    times: list[int] = []
    title, untrained, span = "", False, ""
    for frame in reader.frames():
        recorded = recorded_boxes(frame)
        boxes.update(recorded.boxes.classes.tolist())
        for name in frame.texts(entities.RUN, "layer_names"):
            boxes[name] += len(frame.texts(entities.layer(entities.WORLD, name), "name"))
        times.append(recorded.stamp.timestamp_ns)
        title = "".join(frame.texts(entities.RUN, "title"))
        untrained = any(frame.integers(entities.RUN, "untrained"))
    if reader.left_out:
        span = f" ({reader.left_out} without vehicle or boxes left out: is the file damaged?)"
    if times:
        start = datetime.fromtimestamp(min(times) / 1e9, UTC).isoformat(sep=" ", timespec="milliseconds")
        span = f", {(max(times) - min(times)) / 1e9:.2f} s from {start}{span}"
    by_size = sizes.most_common()
    rest = by_size[SHOWN_ENTITIES:]
    return "\n".join([
        f"{path}: {title or 'a recording'}{' (UNTRAINED weights)' if untrained else ''}",
        f"  frames    {len(times)}{span}",
        f"  size      {_size(path.stat().st_size)}",
        f"  boxes     {boxes.total()}",
        *(f"    {count:7d} {name}" for name, count in boxes.most_common()),
        f"  entities  {len(sizes)}, by size",
        *(f"    {_size(size):>9} {entity}" for entity, size in by_size[:SHOWN_ENTITIES]),
        *([f"    {_size(sum(size for _, size in rest)):>9} in {len(rest)} others"] if rest else []),
    ])  # fmt: skip


def _size(count: int) -> str:
    for unit in ("B", "kB", "MB"):
        if count < 1000:
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count = count / 1000  # type: ignore[assignment]
    return f"{count:.1f} GB"
