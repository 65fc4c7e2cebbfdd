"""A vector per frame, the BEV features pooled over the grid, and the frames of a batch that are most similar to one."""

import base64
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from html import escape
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.errors import BevcliError, InputError
from bevcli.frame import Frame, Prediction
from bevcli.geometry.transforms import Array
from bevcli.runs.files import RECORDING
from bevcli.runs.state import load_state, save_state
from bevcli.viewer.recording_file import open_recording
from bevcli.viewer.video import draw_frame_at
from bevcli.workshop.batch.job import READING_THREADS, RESULTS
from bevcli.workshop.batch.report import page
from bevcli.workshop.batch.storage import LocalFolder, Storage

THUMBNAIL_WIDTH, JPEG_QUALITY = 640, 80  # pixels, percent
EMBEDDINGS = "embeddings.safetensors"


@dataclass(frozen=True)
class Embeddings:
    """The vectors of a drive.

    Attributes:
        frames: (F,) int64 indices of the frames.
        timestamps_ns: (F,) int64.
        vectors: (F, 2 C) float32: the mean of each of the C channels of the BEV features over all cells, then the
            standard deviations.
        model: name of the model and hash of its weights. Vectors of different models cannot be compared.
    """

    frames: NDArray[np.int64]
    timestamps_ns: NDArray[np.int64]
    vectors: NDArray[np.float32]
    model: str


class FramePooling:
    """Collects the vectors of a run, frame by frame. Frames without BEV features are left out."""

    def __init__(self, model: str) -> None:
        self._model = model
        self._rows: list[tuple[int, int, NDArray[np.float32]]] = []

    def add(self, frame: Frame, prediction: Prediction) -> None:
        """Add a frame."""
        if prediction.bev is None or prediction.skipped or prediction.not_finite:
            return
        features = prediction.bev.float().reshape(-1, prediction.bev.shape[-1])  # (rows * columns, C)
        vector = np.concatenate([features.mean(dim=0).cpu().numpy(), features.std(dim=0).cpu().numpy()])
        self._rows.append((frame.stamp.index, frame.stamp.timestamp_ns, vector))

    def write(self, folder: Path) -> None:
        """Write embeddings.safetensors into a folder. Raises OutputError."""
        rows = self._rows
        vectors = np.array([vector for _, _, vector in rows]) if rows else np.zeros((0, 0), dtype=np.float32)
        frames, times = (np.array([row[i] for row in rows], dtype=np.int64) for i in range(2))
        save_state(folder / EMBEDDINGS, Embeddings(frames, times, vectors, self._model))


def read_embeddings(path: Path) -> Embeddings:
    """The vectors in a file of `FramePooling.write`. Raises InputError."""
    if not path.is_file():
        raise InputError(f"{path}: is missing (expected a result of `bevcli batch --embed`)")
    found = load_state(path, Embeddings)
    frames = (found.frames.shape, found.timestamps_ns.shape, found.vectors.shape[:1])
    if found.vectors.ndim != 2 or len(set(frames)) != 1:
        raise InputError(
            f"{path}: does not contain the vectors of a drive (expected a result of `bevcli batch --embed`)"
        )
    return found


@dataclass(frozen=True)
class SimilarFrame:
    """A frame of a batch. result: folder of its drive's results. similarity: -1 to 1, 1 for an equal vector."""

    result: str
    frame: int
    similarity: float


@dataclass(frozen=True)
class Query:
    """The frame that is searched for.

    Attributes:
        result: name of the folder of its drive's results.
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
            raise InputError(f"`frame={self.frame}`: {self.result} has no vector of this frame (found frames {found})")
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


def find_like(
    query: Query, batch: Storage, count: int = 12, per_drive: int = 3, *, same_drive: bool = False
) -> list[SimilarFrame]:
    """The frames of a batch that are most similar to a frame, the most similar first.

    Each dimension of the vectors is scaled to mean 0 and standard deviation 1 over all frames of the batch; the
    similarity is the cosine of two scaled vectors. The frame itself is left out.

    per_drive: at most this many frames of each drive. same_drive: frames of the query's own drive, too.
    Raises InputError where the batch has no vectors, or they are of another model.
    """
    results = sorted(batch.names(RESULTS))

    def read(result: str) -> Embeddings | None:
        return _embeddings(batch, result) if EMBEDDINGS in batch.names(f"{RESULTS}/{result}") else None

    with ThreadPoolExecutor(READING_THREADS) as pool:
        read_all = zip(results, pool.map(read, results), strict=True)
        drives = [(result, found) for result, found in read_all if found is not None]
    if not drives:
        raise InputError(f"{batch.where}: no drive has {EMBEDDINGS} (expected one of `bevcli batch --embed`)")
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
    chosen: list[SimilarFrame] = []
    taken: Counter[str] = Counter()
    for place in np.argsort(-similarity, kind="stable"):
        result, frame = comparable[owners[place]][0], int(frames[place])
        is_own = query.recording is None and result == query.result
        if taken[result] >= per_drive or (is_own and (not same_drive or frame == query.frame)):
            continue
        taken[result] += 1
        chosen.append(SimilarFrame(result, frame, float(similarity[place])))
        if len(chosen) == count:
            break
    return chosen


def similar_frames_page(query: Query, batch: Storage, found: Sequence[SimilarFrame]) -> str:
    """A page with a thumbnail of each frame, as HTML."""
    figures = [_figure(batch, query.result, query.frame, "the frame that is searched for", query.recording)]
    figures += [_figure(batch, each.result, each.frame, f"similarity {each.similarity:.3f}") for each in found]
    title = f"Frames like frame {query.frame} of {query.result}"
    body = f'<h1>{escape(title)}</h1><p class="soft">in {escape(batch.where)}</p>'
    return page(title, f'{body}<div class="charts">{"".join(figures)}</div>')


def _figure(batch: Storage, result: str, frame: int, text: str, recording: Path | None = None) -> str:
    image = _thumbnail(batch, result, frame, recording)
    shown = f'<img alt="" src="data:image/jpeg;base64,{image}">' if image else '<p class="none">no recording</p>'
    return f"<figure>{shown}<figcaption>{escape(result)}, frame {frame}</figcaption>{escape(text)}</figure>"


def _thumbnail(batch: Storage, result: str, frame: int, recording: Path | None) -> str:
    """A frame of a recording, as base64 of a JPEG; "" where the recording cannot be read."""
    try:
        with batch.copied(f"{RESULTS}/{result}/{RECORDING}") as copy, open_recording(recording or copy) as file:
            image = draw_frame_at(file, frame)
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
    with batch.copied(f"{RESULTS}/{result}/{EMBEDDINGS}") as path:
        return read_embeddings(path)
