"""The second witness: a detector of people, cycles and vehicles in images, which learned from photographs alone.

Its weights are those of the detector in the model `photographs`. That model's own boxes in images are these.
"""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bevcli.frame import Frame
from bevcli.geometry.boxes import Boxes2D
from bevcli.inference.load import load_model
from bevcli.inference.preprocess import Preprocessor, camera_boxes
from bevcli.model.step import model_inputs
from bevcli.parsing.documents import CsvRow, csv_rows
from bevcli.sequences.files.boxes_table import IMAGE_COLUMNS
from bevcli.workshop.trust.sightings import Seen


class Witness:
    """The detector of the model `photographs`, on the CPU."""

    def __init__(self) -> None:
        model = load_model("photographs", device="cpu")
        self._network: Any = model.network
        self._preprocessor = Preprocessor(model.config, threads=1)

    def seen(self, frame: Frame) -> Seen:
        """Camera -> the boxes in its image, of the cameras that have one."""
        prepared, config = self._preprocessor(frame), self._preprocessor.config
        if not prepared.has_image.any():
            return {}
        inputs = model_inputs(prepared, None, config)
        with torch.inference_mode():
            found = self._network.find_image_boxes(inputs.images, inputs.has_image, inputs.image_sizes)
        return camera_boxes(found, prepared, config.image)


load_witness = cache(Witness)


def seen_in_run(path: Path) -> dict[tuple[int, int], dict[str, Boxes2D]]:
    """The image_boxes.csv of a run: index and time of a frame -> camera -> boxes. Raises InputError."""
    rows: dict[tuple[int, int], dict[str, list[CsvRow]]] = {}
    for row in csv_rows(path, IMAGE_COLUMNS, may_be_empty=True):
        of_frame = rows.setdefault((row.integer("frame"), row.integer("timestamp_ns")), {})
        of_frame.setdefault(row.cells["camera"], []).append(row)
    return {stamp: {name: _boxes(of) for name, of in cameras.items()} for stamp, cameras in rows.items()}


def _boxes(rows: list[CsvRow]) -> Boxes2D:
    scores, *corners = (np.array([row.number(name) for row in rows]) for name in ("score", "x0", "y0", "x1", "y1"))
    return Boxes2D(np.stack(corners, -1), np.array([row.cells["class"] for row in rows]), scores)
