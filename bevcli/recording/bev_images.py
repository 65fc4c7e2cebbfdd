"""BEV features as images: their norm, one channel, or three principal components as colours.

The components and the colour range are fitted on the first two frames and then kept, so that a colour means the same
in every frame. Therefore the image of the first frame is ready only when the second frame was pushed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.geometry.transforms import Array
from bevcli.recording.colors import colormap

Stamp = TypeVar("Stamp")
Features = NDArray[np.float32]
FITTED_ON = 2  # frames
CELLS_FOR_FIT = 4000  # of each frame, evenly spaced
PERCENTILES = (1.0, 99.0)  # become the darkest and the brightest colour


@dataclass(frozen=True)
class BevColors:
    """A fixed mapping from features to colours.

    Attributes:
        mean: (C,) subtracted from the features.
        basis: (C, K) projection, K 1 or 3; None takes the norm of the features (K 1).
        low: (K,) values that become 0.
        high: (K,) values that become 1.
    """

    mean: Features
    basis: Features | None
    low: Array
    high: Array

    def paint(self, features: Features) -> NDArray[np.uint8]:
        """Features (..., C) -> (..., 3) uint8 RGB."""
        values = _values(features, self.mean, self.basis)
        shares = np.clip((values - self.low) / np.maximum(self.high - self.low, 1e-9), 0, 1)
        if shares.shape[-1] == 1:
            return colormap(shares[..., 0], "inferno")
        return (shares * 255).astype(np.uint8)


def fit_colors(kind: str, features: Features) -> BevColors:
    """Fits colours to features (cells, C). kind: "norm", "pca" or "channel:K".

    Raises InputError when the features have no channel K.
    """
    channels = features.shape[-1]
    mean: Features = np.zeros(channels, np.float32)
    basis: Features | None = None
    if kind == "pca":
        mean = features.mean(0)
        basis = _principal_components(features - mean)
    elif kind.startswith("channel:"):
        chosen = int(kind.partition(":")[2])
        if chosen >= channels:
            raise InputError(f"--bev {kind}: the BEV map has channels 0 to {channels - 1}")
        basis = np.eye(channels, dtype=np.float32)[:, chosen : chosen + 1]
    low, high = np.percentile(_values(features, mean, basis), PERCENTILES, axis=0)
    return BevColors(mean, basis, low, high)


class BevImages(Generic[Stamp]):
    """Takes the features of each frame; returns the images that are ready, each with the stamp of its frame.

    Attributes:
        colors: fitted on the first frames, None before. Setting them continues an interrupted recording.
    """

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self.colors: BevColors | None = None
        self._waiting: list[tuple[Stamp, Features]] = []

    def push(self, stamp: Stamp, features: Features) -> list[tuple[Stamp, NDArray[np.uint8]]]:
        """Adds a frame; returns the images that are ready.

        features: (rows, columns, C); the first row has the smallest y. The images are (rows, columns, 3) uint8 RGB;
        their first row has the largest y.
        """
        self._waiting.append((stamp, features))
        if self.colors is None and len(self._waiting) < FITTED_ON:
            return []
        return self.finish()

    def finish(self) -> list[tuple[Stamp, NDArray[np.uint8]]]:
        """The images that are not returned yet: that of the first frame, where there was no second one."""
        if not self._waiting:
            return []
        if self.colors is None:
            self.colors = fit_colors(self.kind, np.concatenate([_thinned(f) for _, f in self._waiting]))
        colors = self.colors
        ready = [(stamp, np.ascontiguousarray(colors.paint(f)[::-1])) for stamp, f in self._waiting]
        self._waiting = []
        return ready


def _values(features: Features, mean: Features, basis: Features | None) -> Features:
    if basis is None:
        return np.asarray(np.linalg.norm(features, axis=-1, keepdims=True), dtype=np.float32)
    return np.asarray((features - mean) @ basis, dtype=np.float32)


def _thinned(features: Features) -> Features:
    cells = features.reshape(-1, features.shape[-1])
    return cells[:: max(1, len(cells) // CELLS_FOR_FIT)]


def _principal_components(centered: Features) -> Features:
    _, vectors = np.linalg.eigh(centered.T @ centered)
    basis = vectors[:, :-4:-1]  # the three largest, largest first
    signs = np.sign(basis[np.abs(basis).argmax(0), np.arange(basis.shape[1])])
    # The sign of an eigenvector is arbitrary: make its largest entry positive.
    return basis * np.where(signs == 0, 1, signs).astype(np.float32)
