"""One vector per frame: BEV features pooled over the grid, so that frames can be searched by similarity."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.frame import Frame, Prediction
from bevcli.pipeline.state_file import load_state, save_state

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
        """Adds a frame."""
        if prediction.bev is None or prediction.skipped or prediction.not_finite:
            return
        features = prediction.bev.float().reshape(-1, prediction.bev.shape[-1])  # (rows * columns, C)
        vector = np.concatenate([features.mean(dim=0).cpu().numpy(), features.std(dim=0).cpu().numpy()])
        self._rows.append((frame.stamp.index, frame.stamp.timestamp_ns, vector))

    def write(self, folder: Path) -> None:
        """Writes embeddings.safetensors into a folder. Raises OutputError."""
        rows = self._rows
        vectors = np.array([vector for _, _, vector in rows]) if rows else np.zeros((0, 0), dtype=np.float32)
        frames, times = (np.array([row[i] for row in rows], dtype=np.int64) for i in range(2))
        save_state(folder / EMBEDDINGS, Embeddings(frames, times, vectors, self._model))


def read_embeddings(path: Path) -> Embeddings:
    """The vectors in a file of `FramePooling.write`. Raises InputError."""
    if not path.is_file():
        raise InputError(f"{path}: is missing (expected a result of `bevcli batch --embed`)")
    found = load_state(path)
    if not isinstance(found, Embeddings) or found.vectors.ndim != 2 or len(found.vectors) != len(found.frames):
        raise InputError(
            f"{path}: does not contain the vectors of a drive (expected a result of `bevcli batch --embed`)"
        )
    return found
