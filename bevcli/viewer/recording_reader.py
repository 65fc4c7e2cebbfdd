"""Reads a recording frame by frame, in the order of writing, with one frame at a time in memory."""

import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from rerun.chunk import Chunk, RrdReader

from bevcli.errors import InputError
from bevcli.geometry.transforms import Array
from bevcli.recording import entities

Row = dict[str, pa.Scalar]


@dataclass(frozen=True)
class RecordedFrame:
    """The state of all entities at one frame.

    Attributes:
        index: the frame's index.
        rows: by entity, then by component: the newest value, static ones included.
    """

    index: int
    rows: Mapping[str, Row]

    def has(self, entity: str, component: str) -> bool:
        """True if the entity has a value for this component."""
        return component in self.rows.get(entity, {}) and self.rows[entity][component].is_valid

    def values(self, entity: str, component: str) -> list[Any]:
        """The values of a component as Python objects; [] if there are none."""
        return self.rows[entity][component].as_py() if self.has(entity, component) else []

    def array(self, entity: str, component: str, width: int) -> Array:
        """The values of a component as (N, width) float64, `width` numbers each; (0, width) if there are none."""
        return np.asarray(self._numbers(entity, component), dtype=np.float64).reshape(-1, width)

    def blob(self, entity: str, component: str) -> bytes:
        """The bytes of a component that is one blob, such as a JPEG; empty if there is none."""
        return np.asarray(self._numbers(entity, component), dtype=np.uint8).tobytes()

    def _numbers(self, entity: str, component: str) -> pa.Array:
        if not self.has(entity, component):
            return pa.array([], pa.uint8())
        values = self.rows[entity][component].values
        while pa.types.is_nested(values.type):
            values = values.flatten()
        return values


class RecordingReader:
    """A recording that `Recording` wrote. Raises InputError if the file cannot be read."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with self._reading():
            self._reader = RrdReader(path)

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
        """The frames in order, each with the state of all entities."""
        state: dict[str, Row] = {}
        current: int | None = None
        for entity, frame, row in self._rows():
            if frame is not None and (current is None or frame > current):
                if current is not None:
                    yield RecordedFrame(current, dict(state))
                current = frame
            if frame is None or frame == current:  # not a BEV image that was written late for an earlier frame
                _apply(state, entity, row)
        if current is not None:
            yield RecordedFrame(current, dict(state))

    def _rows(self) -> Iterator[tuple[str, int | None, Row]]:
        for chunk in self.chunks():
            batch = chunk.to_record_batch()
            names = [field.name for field in batch.schema if (field.metadata or {}).get(b"rerun:kind") == b"data"]
            timed = entities.FRAME_TIMELINE in batch.schema.names
            for i in range(batch.num_rows):
                frame = batch.column(entities.FRAME_TIMELINE)[i].as_py() if timed else None
                yield chunk.entity_path.strip("/"), frame, {n: batch.column(n)[i] for n in names}


def _apply(state: dict[str, Row], entity: str, row: Row) -> None:
    if "Clear:is_recursive" in row:
        state.pop(entity, None)
        return
    state[entity] = {**state.get(entity, {}), **{n: value for n, value in row.items() if value.is_valid}}
