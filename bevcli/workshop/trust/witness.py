"""The second witness: a detector of people, cycles and vehicles in images, which learned from photographs alone.

Its weights are those of the detector in the model `photographs`. That model's own boxes in images are these.
"""

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import torch

from bevcli.checkpoints import bundled_weights, read_safetensors
from bevcli.config import load_config
from bevcli.errors import InputError
from bevcli.frame import Frame
from bevcli.geometry.boxes import Boxes2D
from bevcli.inference.preprocess import Preprocessor, camera_boxes
from bevcli.model.nanodet import NanoDet, NanoDetConfig
from bevcli.parsing.documents import CSV_BYTES
from bevcli.parsing.files import read_text
from bevcli.sequences.files.boxes_table import IMAGE_COLUMNS

SOURCE, PART = "photographs", "image_detector."  # the model of the package whose weights have the detector's, and where


@dataclass(frozen=True)
class Witness:
    """A detector, and how it gets its images."""

    detector: NanoDet
    preprocessor: Preprocessor

    def seen(self, frame: Frame) -> Mapping[str, Boxes2D]:
        """Camera -> the boxes in its image, of the cameras that have one."""
        prepared = self.preprocessor(frame)
        if not prepared.has_image.any():
            return {}
        with torch.inference_mode():
            maps = self.detector(prepared.images.flatten(0, 1).contiguous(memory_format=torch.channels_last))
            found = self.detector.image_boxes(maps, prepared.has_image)
        return camera_boxes(found, prepared, self.preprocessor.config.image)


def seen_in_run(path: Path) -> dict[tuple[int, int], dict[str, Boxes2D]]:
    """The image_boxes.csv of a run: index and time of a frame -> cell of a camera -> boxes. Raises InputError."""
    rows: dict[tuple[int, int], dict[str, list[list[str]]]] = {}
    try:
        table = csv.reader(read_text(path, CSV_BYTES).splitlines())
        if next(table, None) != list(IMAGE_COLUMNS):
            raise ValueError(f"expected the columns {', '.join(IMAGE_COLUMNS)}")
        for index, _, time, camera, *cells in table:
            rows.setdefault((int(index), int(time)), {}).setdefault(camera, []).append(cells)
        return {stamp: {name: _boxes(of) for name, of in cameras.items()} for stamp, cameras in rows.items()}
    except (ValueError, csv.Error) as error:
        raise InputError(f"{path}: cannot be read as boxes in images ({error}): run again with --force") from None


def _boxes(rows: list[list[str]]) -> Boxes2D:
    """Boxes of rows of class, score and edges."""
    numbers = np.array([row[1:] for row in rows], dtype=np.float64).reshape(len(rows), 5)
    if not np.isfinite(numbers).all():
        raise ValueError("a number is not finite")
    return Boxes2D(numbers[:, 1:], np.array([row[0] for row in rows]), numbers[:, 0])


@cache
def load_witness() -> Witness:
    """The witness of the package, on the CPU."""
    path = bundled_weights(SOURCE)
    assert path is not None
    tensors, _ = read_safetensors(path)
    detector = NanoDet(NanoDetConfig())
    detector.load_state_dict({key.removeprefix(PART): x for key, x in tensors.items() if key.startswith(PART)})
    return Witness(detector.eval().to(memory_format=torch.channels_last), Preprocessor(load_config(SOURCE), threads=1))  # type: ignore[call-overload]
