"""`calibration_images`: the images of some frames of drives, as an exported file takes them."""

from __future__ import annotations

from collections.abc import Iterator
from collections.abc import Sequence as Items

import numpy as np

from bevcli.engines.exported import raw_images
from bevcli.errors import InputError
from bevcli.frame import Sequence
from bevcli.model.bevformer import BEVFormerConfig
from bevcli.pipeline.preprocess import Preprocessor


def calibration_images(
    config: BEVFormerConfig, cameras: int, drives: Items[Sequence], frames: int
) -> Iterator[np.ndarray]:
    """Yields (1, N, H, W, 3) float32, the input `images` of an exported file, for frames of these drives.

    Args:
        config: of the model.
        cameras: N, the number of cameras of the exported file.
        drives: whose frames are read; frames without any image are left out.
        frames: at most so many, evenly spaced over all frames of all drives.

    Raises:
        InputError: a frame cannot be read, or a rig has another number of cameras.
    """
    places = [(drive, place) for drive in drives for place in range(len(drive.stamps))]
    chosen = np.linspace(0, len(places) - 1, min(frames, len(places))).round().astype(int)
    preprocessors = {id(drive): Preprocessor(config) for drive in drives}
    for drive, place in (places[index] for index in chosen):
        prepared = preprocessors[id(drive)](drive.load(place))
        if len(prepared.assignment.cameras) != cameras:
            raise InputError(f"{drive.name}: has {len(prepared.assignment.cameras)} cameras (the file takes {cameras})")
        if prepared.frame.images:
            yield raw_images(prepared.images, config).numpy()
