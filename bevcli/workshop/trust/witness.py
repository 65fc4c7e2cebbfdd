"""The second witness: a detector of people, cycles and vehicles in images, which learned from photographs alone.

Its weights are those of the detector in the model `photographs`. That model's own boxes in images are these.
"""

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bevcli.frame import Frame
from bevcli.geometry.boxes import Boxes2D, Boxes3D
from bevcli.geometry.transforms import Array, inverse
from bevcli.inference.load import load_model
from bevcli.inference.preprocess import Preprocessor, camera_boxes
from bevcli.model.step import model_inputs
from bevcli.parsing.documents import CsvRow, csv_rows
from bevcli.sequences.files.boxes_table import IMAGE_COLUMNS
from bevcli.workshop.trust.sightings import LEAST_PX, OF_COCO, SURE, Seen, overlaps, projected


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


def overlaps_seen(frame: Frame, readings: Sequence[Boxes3D]) -> Array:
    """(R, D) the largest overlap of D objects in the images of a frame with a box, of each of R sets of boxes.

    readings: in the world frame.
    """
    found = [np.zeros((len(readings), 0))]
    for name, objects in load_witness().seen(frame).items():
        camera, height = frame.rig[name], objects.corners[:, 3] - objects.corners[:, 1]
        is_sure = (objects.scores >= SURE) & (height >= LEAST_PX) & [each in OF_COCO for each in objects.classes]
        camera_from_world = inverse(frame.world_from_ego_at[name].matrix @ camera.ego_from_camera)
        edge = np.tile([camera.width - 1, camera.height - 1], 2)
        shown = [np.clip(projected(boxes, camera_from_world, camera), 0, edge) for boxes in readings]
        best = [overlaps(each, objects.corners[is_sure]).max(axis=0, initial=0) for each in shown]
        found.append(np.stack(best))
    return np.concatenate(found, axis=1)


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
