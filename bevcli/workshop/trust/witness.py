"""The second witness: a detector of people, cycles and vehicles in images, which learned from photographs alone.

Its weights are those of the detector in the model `photographs`. That model's own boxes in images are these. It also
shows what a file of labels holds.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bevcli.frame import Drive, Frame
from bevcli.geometry.boxes import Boxes2D, Boxes3D
from bevcli.geometry.transforms import Array, inverse
from bevcli.inference.load import load_model
from bevcli.inference.preprocess import Preprocessor, camera_boxes
from bevcli.model.step import model_inputs
from bevcli.parsing.documents import CsvRow, csv_rows
from bevcli.sequences.files.boxes_table import IMAGE_COLUMNS
from bevcli.sequences.files.readings import differing
from bevcli.workshop.formats.label_readings import USUAL, LabelReading, PlacedBoxes
from bevcli.workshop.trust.sightings import LEAST_PX, OF_COCO, SURE, Seen, overlaps, projected

MOST_FRAMES, MOST_PROJECTED = 4, 15_000  # frames that are looked at for labels; boxes of all readings in them
# Overlaps of a box and an object: they belong together; mean of a reading that fits; spread where one object was seen.
BELONGING, SOUND_OVERLAP, SPREAD = 0.2, 0.35, 0.2
CLEARLY, CLEARLY_USUAL = 3.0, 1.0  # standard errors by which a reading is worse than the best, and than the usual one


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


def shown_by_images(
    drive: Drive, placed: Mapping[int, PlacedBoxes], readings: Sequence[LabelReading]
) -> list[LabelReading]:
    """The readings of a file of labels that fit the images, in their order; all where the images do not tell.

    A box must lie on an object that the witness sees.

    Args:
        drive: of the labels.
        placed: the boxes by index of the frame; four frames at most are looked at.
        readings: of the file, the usual one first.
    """
    indices = [index for index in sorted(placed) if len(placed[index].boxes)]
    many = len(readings) * sum(len(placed[index].boxes) for index in indices)
    count = min(MOST_FRAMES, len(indices), max(1, MOST_PROJECTED * len(indices) // max(many, 1)))
    found = [np.zeros((len(readings), 0))]
    looked_at = [indices[place] for place in np.linspace(0, len(indices) - 1, count).astype(int)]
    for index in looked_at:
        found += _overlaps_seen(drive.load(index), [placed[index].read_as(each.states) for each in readings])
    overlap = np.concatenate(found, axis=1)  # (R, D)
    best = overlap[overlap.sum(axis=1).argmax()]
    boxes_seen = min(len(best), sum(len(placed[index].boxes) for index in looked_at) / 2)
    if best.sum() < SOUND_OVERLAP * max(boxes_seen, 1):
        return list(readings)
    kept = [index for index, own in enumerate(overlap) if _clearness(best, own) < CLEARLY]
    if 0 in kept:
        kept = [index for index in kept if not index or _clearness(overlap[0], overlap[index]) < CLEARLY_USUAL]
    left = [replace(readings[index], doubt="") for index in kept]
    others = [index for index in range(len(readings)) if index not in kept]
    if not others:
        return left
    fits = overlap.mean(axis=1)
    nearest = max(others, key=lambda index: float(fits[index]))
    other, shown = readings[nearest], []
    for reading, fit in zip(left, fits[kept], strict=True):
        names = differing([reading, other])
        told = [name for name, value in reading.states.items() if name in names or value != USUAL.get(name)]
        note = f"{reading.words(told)} (the images: overlap {fit:.2f}; {other.words(names)}: {fits[nearest]:.2f})"
        shown.append(replace(reading, notes=(*reading.notes, note)))
    return shown


def _overlaps_seen(frame: Frame, readings: Sequence[Boxes3D]) -> Iterator[Array]:
    """(R, D) for each image, the largest overlap of D objects with a box, of each of R sets of boxes (world frame)."""
    for name, objects in load_witness().seen(frame).items():
        camera, height = frame.rig[name], objects.corners[:, 3] - objects.corners[:, 1]
        is_sure = (objects.scores >= SURE) & (height >= LEAST_PX) & [each in OF_COCO for each in objects.classes]
        camera_from_world = inverse(frame.world_from_ego_at[name].matrix @ camera.ego_from_camera)
        edge = np.tile([camera.width - 1, camera.height - 1], 2)
        shown = [np.clip(projected(boxes, camera_from_world, camera), 0, edge) for boxes in readings]
        yield np.stack([overlaps(each, objects.corners[is_sure]).max(axis=0, initial=0) for each in shown])


def _clearness(one: Array, other: Array) -> float:
    """Mean difference of overlaps (D,) with objects, in standard errors."""
    differences = (one - other)[np.maximum(one, other) > BELONGING]
    count, mean = max(len(differences), 1), float(differences.sum()) / max(len(differences), 1)
    return mean * count / float(np.sqrt(np.square(differences - mean).sum() + SPREAD**2))


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
