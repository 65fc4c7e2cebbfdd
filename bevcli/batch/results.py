"""The results of a batch as files: batch.parquet, batch.csv and the joint metrics."""

from __future__ import annotations

import csv
import io
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from bevcli.batch.storage import LocalFolder, Storage
from bevcli.batch.worker import MATCHES, RESULTS, Record
from bevcli.errors import InputError
from bevcli.evaluation.config import ERRORS, DetectionConfig
from bevcli.evaluation.joint import DriveMatches, score_jointly
from bevcli.evaluation.scores_report import scores_to_dict
from bevcli.frame import MAP_CLASSES
from bevcli.geometry.boxes import CLASSES
from bevcli.pipeline.state_file import load_state

READING_THREADS = 16

_TEXTS = ("drive", "source", "scene", "result", "error")
_COUNTS = ("attempts", "frames", "boxes", "tracks", "dropped_images", "skipped_frames", "not_finite_frames")
_NUMBERS = ("seconds", "frames_per_second", "fetch_seconds")
_METRICS = ("mean_ap", "nd_score", *ERRORS, *(f"iou_{name}" for name in MAP_CLASSES))
COLUMNS: dict[str, pa.DataType] = {
    **dict.fromkeys(_TEXTS, pa.string()),
    **dict.fromkeys(_COUNTS, pa.int64()),
    **dict.fromkeys(_NUMBERS, pa.float64()),
    "output_bytes": pa.int64(),
    **{f"boxes_{name}": pa.int64() for name in CLASSES},
    **dict.fromkeys(_METRICS, pa.float64()),
    "ground_truth_boxes": pa.int64(),
    "not_scored": pa.string(),
}


def row(record: Record) -> dict[str, Any]:
    """The columns of a drive; None for what is not known, such as metrics without ground truth."""
    boxes = record.get("boxes_by_class")
    flat = {**record, **(record.get("scores") or {})}
    if boxes is not None:
        flat |= {f"boxes_{name}": boxes.get(name, 0) for name in CLASSES}
    return {name: flat.get(name) for name in COLUMNS}


def to_parquet(records: Sequence[Record]) -> bytes:
    """batch.parquet: one row per drive, in the order of the records."""
    table = pa.Table.from_pylist([row(record) for record in records], schema=pa.schema(list(COLUMNS.items())))
    buffer = io.BytesIO()
    pq.write_table(table, buffer)
    return buffer.getvalue()


def to_csv(records: Sequence[Record]) -> bytes:
    """batch.csv: the same columns; an empty field for what is not known."""
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(row(record) for record in records)
    return text.getvalue().encode()


def joint_metrics(out: Storage, records: Sequence[Record], range_m: float) -> dict[str, Any] | None:
    """The scores over all frames of all drives with ground truth, with the keys of `bevcli eval --json`.

    Boxes of all drives are scored together: the result is not a mean of the drives' scores.

    Args:
        out: the batch's folder.
        records: of all drives; those without scores are left out.
        range_m: distance beyond which nothing was scored, metres.

    Returns:
        The scores; None if no drive was scored.

    Raises InputError where the matches of a drive cannot be read.
    """
    scored = [record for record in records if record.get("scores")]
    if not scored:
        return None
    with ThreadPoolExecutor(READING_THREADS) as pool:
        matches = list(pool.map(lambda record: _read_matches(out, record), scored))
    config = DetectionConfig().cut_at(range_m)
    detection, segmentation = score_jointly(matches, config)
    notes = (f"{len(scored)} drives are scored together; nothing beyond {range_m:g} m is scored",)
    return {"drives": len(scored), **scores_to_dict(detection, config, segmentation, notes)}


def _read_matches(out: Storage, record: Record) -> DriveMatches:
    with LocalCopy(out, f"{RESULTS}/{record['result']}/{MATCHES}") as path:
        found = load_state(path)
    if not isinstance(found, DriveMatches):
        raise InputError(f"{out.where}/{RESULTS}/{record['result']}/{MATCHES}: is not the matching of a drive")
    return found


class LocalCopy:
    """`with LocalCopy(storage, name) as path:` the file on this machine; of an object store, a temporary copy."""

    def __init__(self, storage: Storage, name: str) -> None:
        self._storage, self._name = storage, name
        self._folder: tempfile.TemporaryDirectory[str] | None = None

    def __enter__(self) -> Path:
        """Raises InputError where the file is missing."""
        if isinstance(self._storage, LocalFolder):
            return self._storage.path / self._name
        content = self._storage.read(self._name)
        if content is None:
            raise InputError(f"{self._storage.where}/{self._name}: is missing")
        self._folder = tempfile.TemporaryDirectory(prefix="bevcli-")
        path = Path(self._folder.name) / Path(self._name).name
        path.write_bytes(content)
        return path

    def __exit__(self, *_: object) -> None:
        if self._folder is not None:
            self._folder.cleanup()
