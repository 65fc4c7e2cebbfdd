"""`find_like`: the frames of a batch that are most similar to one frame, by the distance of their vectors."""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from html import escape
from pathlib import Path

import cv2
import numpy as np

from bevcli.batch.embeddings import EMBEDDINGS, Embeddings, read_embeddings
from bevcli.batch.report import page
from bevcli.batch.results import READING_THREADS, LocalCopy
from bevcli.batch.storage import LocalFolder, Storage
from bevcli.batch.worker import RESULTS
from bevcli.errors import BevcliError, InputError
from bevcli.geometry.transforms import Array
from bevcli.pipeline.run_files import RECORDING
from bevcli.viewer.recording_file import open_recording
from bevcli.viewer.video import draw_frame_at

THUMBNAIL_WIDTH, JPEG_QUALITY = 640, 80  # pixels, percent
_QUERY = "the frame that is searched for"


@dataclass(frozen=True)
class SimilarFrame:
    """A frame of a batch.

    Attributes:
        result: name of the folder of its drive's results.
        frame: its index.
        timestamp_ns: its time.
        similarity: -1 to 1, 1 for an equal vector.
    """

    result: str
    frame: int
    timestamp_ns: int
    similarity: float


@dataclass(frozen=True)
class Query:
    """The frame that is searched for.

    Attributes:
        result: name of the folder of its drive's results; the name of the folder for a run outside of the batch.
        frame: its index.
        embeddings: of its drive.
        recording: of its drive; None if it is in the batch.
    """

    result: str
    frame: int
    embeddings: Embeddings
    recording: Path | None = None

    @property
    def vector(self) -> Array:
        """(D,) its vector. Raises InputError where the frame has none."""
        places = np.flatnonzero(self.embeddings.frames == self.frame)
        if not len(places):
            frames = self.embeddings.frames
            found = f"{frames.min()} to {frames.max()}" if len(frames) else "none"
            raise InputError(f"--frame {self.frame}: {self.result} has no vector of this frame (found frames {found})")
        return self.embeddings.vectors[places[0]].astype(np.float64)


def open_query(run: str, frame: int, batch: Storage) -> Query:
    """The frame of a run: a folder with embeddings.safetensors, or the name of a drive of the batch.

    Raises InputError where there is no such run, or several drives have this name.
    """
    if (Path(run) / EMBEDDINGS).is_file():
        folder = Path(run).absolute()
        inside = isinstance(batch, LocalFolder) and folder.parent == (batch.path / RESULTS).absolute()
        return Query(folder.name, frame, read_embeddings(folder / EMBEDDINGS), None if inside else folder / RECORDING)
    names = sorted(batch.names(RESULTS))
    found = [name for name in names if name == run] or [name for name in names if name.rpartition("-")[0] == run]
    if len(found) != 1:
        what = f"is the name of several drives ({', '.join(found[:4])})" if found else "is not a drive of the batch"
        raise InputError(
            f"{run}: {what}, and not a folder with {EMBEDDINGS} (expected a result of `bevcli batch --embed`)"
        )
    return Query(found[0], frame, _embeddings(batch, found[0]))


def find_like(query: Query, batch: Storage, count: int = 12, per_drive: int = 3) -> list[SimilarFrame]:
    """The frames of a batch that are most similar to a frame, the most similar first.

    Each dimension of the vectors is scaled to mean 0 and standard deviation 1 over all frames of the batch; the
    similarity is the cosine of two scaled vectors. The frame itself is left out.

    Args:
        query: of `open_query`.
        batch: the folder of a batch that was run with `embed`.
        count: number of frames.
        per_drive: at most this many frames of each drive.

    Raises:
        InputError: the batch has no vectors, or they are of another model.
    """
    results = sorted(batch.names(RESULTS))
    with ThreadPoolExecutor(READING_THREADS) as pool:
        read = pool.map(lambda result: _embeddings_if_any(batch, result), results)
        drives = [(result, found) for result, found in zip(results, read, strict=True) if found is not None]
    if not drives:
        raise InputError(f"{batch.where}: no drive has {EMBEDDINGS} (expected a batch with --embed)")
    same = (query.embeddings.model, query.embeddings.vectors.shape[1])
    comparable = [(result, found) for result, found in drives if (found.model, found.vectors.shape[1]) == same]
    if not comparable:
        raise InputError(
            f"{batch.where}: its vectors are of other models ({drives[0][1].model:.60}) than those of {query.result} "
            f"({query.embeddings.model:.60})"
        )
    vectors = np.concatenate([found.vectors for _, found in comparable])
    similarity = _similarity(query.vector, vectors)
    owners = np.repeat(np.arange(len(comparable)), [len(found.frames) for _, found in comparable])
    frames = np.concatenate([found.frames for _, found in comparable])
    times = np.concatenate([found.timestamps_ns for _, found in comparable])
    chosen: list[SimilarFrame] = []
    taken: Counter[str] = Counter()
    for place in np.argsort(-similarity, kind="stable"):
        result, frame = comparable[owners[place]][0], int(frames[place])
        is_query = query.recording is None and (result, frame) == (query.result, query.frame)
        if is_query or taken[result] >= per_drive:
            continue
        taken[result] += 1
        chosen.append(SimilarFrame(result, frame, int(times[place]), float(similarity[place])))
        if len(chosen) == count:
            break
    return chosen


def similar_frames_page(query: Query, batch: Storage, found: Sequence[SimilarFrame]) -> str:
    """A page with a thumbnail of each frame, as HTML."""
    figures = [_figure(batch, query.result, query.frame, _QUERY, query.recording)]
    figures += [_figure(batch, each.result, each.frame, f"similarity {each.similarity:.3f}") for each in found]
    title = f"Frames like frame {query.frame} of {query.result}"
    body = f'<h1>{escape(title)}</h1><p class="soft">in {escape(batch.where)}</p>'
    return page(title, f'{body}<div class="charts">{"".join(figures)}</div>')


def _figure(batch: Storage, result: str, frame: int, text: str, recording: Path | None = None) -> str:
    image = _thumbnail(batch, result, frame, recording)
    picture = f'<img alt="" src="data:image/jpeg;base64,{image}">' if image else '<p class="none">no recording</p>'
    return f"<figure>{picture}<figcaption>{escape(result)}, frame {frame}</figcaption>{escape(text)}</figure>"


def _thumbnail(batch: Storage, result: str, frame: int, recording: Path | None) -> str:
    """A frame of a recording, as base64 of a JPEG; "" where the recording cannot be read."""
    try:
        with LocalCopy(batch, f"{RESULTS}/{result}/{RECORDING}") as copy, open_recording(recording or copy) as file:
            image = draw_frame_at(file.path, frame)
    except BevcliError:
        return ""
    if image is None:
        return ""
    size = (THUMBNAIL_WIDTH, round(THUMBNAIL_WIDTH * image.shape[0] / image.shape[1]))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    encoded = cv2.imencode(".jpg", small, (cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY))[1]
    return base64.b64encode(encoded.tobytes()).decode()


def _similarity(vector: Array, vectors: np.ndarray) -> Array:
    mean, spread = vectors.mean(axis=0, dtype=np.float64), vectors.std(axis=0, dtype=np.float64)
    scale = np.where(spread > 0, spread, 1)
    scaled, one = (vectors - mean) / scale, (vector - mean) / scale
    norms = np.linalg.norm(scaled, axis=1) * np.linalg.norm(one)
    return np.where(norms > 0, scaled @ one / np.where(norms > 0, norms, 1), 0.0)


def _embeddings(batch: Storage, result: str) -> Embeddings:
    with LocalCopy(batch, f"{RESULTS}/{result}/{EMBEDDINGS}") as path:
        return read_embeddings(path)


def _embeddings_if_any(batch: Storage, result: str) -> Embeddings | None:
    return _embeddings(batch, result) if EMBEDDINGS in batch.names(f"{RESULTS}/{result}") else None
