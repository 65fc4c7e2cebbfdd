"""The summary of a recording: frames, time span, boxes per class, bytes per entity."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from bevcli.recording import entities
from bevcli.viewer.export import recorded_boxes
from bevcli.viewer.recording_reader import RecordingReader

SHOWN_ENTITIES = 15


@dataclass(frozen=True)
class RecordingSummary:
    """The summary of a recording.

    Attributes:
        path: the recording's file.
        file_bytes: its size.
        title: name of the sequence and of the model.
        untrained: whether the model's weights were random.
        timestamps_ns: of the frames, in order.
        boxes: the number of shown boxes by class, largest first.
        bytes_by_entity: size in memory by entity, largest first.
    """

    path: Path
    file_bytes: int
    title: str
    untrained: bool
    timestamps_ns: tuple[int, ...]
    boxes: Mapping[str, int]
    bytes_by_entity: Mapping[str, int]

    def text(self) -> str:
        """The summary as text for a terminal."""
        lines = [f"{self.path}: {self.title}" + (" (UNTRAINED weights)" if self.untrained else "")]
        lines += [f"  frames    {len(self.timestamps_ns)}{self._span()}", f"  size      {_size(self.file_bytes)}"]
        lines += [f"  boxes     {sum(self.boxes.values())}"]
        lines += [f"    {count:7d} {name}" for name, count in self.boxes.items()]
        lines += [f"  entities  {len(self.bytes_by_entity)}, by size"]
        largest = list(self.bytes_by_entity.items())[:SHOWN_ENTITIES]
        lines += [f"    {_size(count):>9} {entity}" for entity, count in largest]
        rest = list(self.bytes_by_entity.values())[SHOWN_ENTITIES:]
        lines += [f"    {_size(sum(rest)):>9} in {len(rest)} others"] if rest else []
        return "\n".join(lines)

    def _span(self) -> str:
        if not self.timestamps_ns:
            return ""
        first, last = min(self.timestamps_ns), max(self.timestamps_ns)
        start = datetime.fromtimestamp(first / 1e9, UTC).isoformat(sep=" ", timespec="milliseconds")
        return f", {(last - first) / 1e9:.2f} s from {start}"


def summarise(path: Path, read_from: Path | None = None) -> RecordingSummary:
    """Summarises the recording at `path`. read_from: its repaired copy, if there is one."""
    reader = RecordingReader(path if read_from is None else read_from)
    sizes: Counter[str] = Counter()
    for chunk in reader.chunks():
        sizes[chunk.entity_path] += chunk.to_record_batch().nbytes
    boxes: Counter[str] = Counter()
    times: list[int] = []
    title, untrained = "", False
    for frame in reader.frames():
        recorded = recorded_boxes(frame)
        boxes.update(recorded.boxes.classes.tolist())
        times.append(recorded.stamp.timestamp_ns)
        title = "".join(frame.texts(entities.RUN, "title"))
        untrained = any(frame.integers(entities.RUN, "untrained"))
    return RecordingSummary(
        path=path,
        file_bytes=path.stat().st_size,
        title=title or "a recording",
        untrained=untrained,
        timestamps_ns=tuple(times),
        boxes=dict(boxes.most_common()),
        bytes_by_entity=dict(sizes.most_common()),
    )


def _size(count: int) -> str:
    for unit in ("B", "kB", "MB"):
        if count < 1000:
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count = count / 1000  # type: ignore[assignment]
    return f"{count:.1f} GB"
