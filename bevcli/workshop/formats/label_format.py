"""The contents of a file of labels, and boxes that cannot be in metres and radians, or whose sides are exchanged."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import wrap_angle

FrameOfReference = Literal["world", "ego", "bev"]
Moment = tuple[int | None, int | None]  # index and time of a frame, ns, as in LabelledFrame
LARGEST_RADIANS, LARGEST_DEGREES = 6.5, 361.0  # a little more than a turn
LONGEST_M, USUAL_M = 300.0, 30.0  # of the longest box, and of the median one; a train has 200 m
IN_CENTIMETRES = 1000.0  # a smaller median is that of boxes in centimetres
LONG = ("car", "truck", "bus", "trailer", "van", "vehicle", "lorry", "taxi", "suv")  # classes that are longer than wide


@dataclass(frozen=True)
class LabelledFrame:
    """The boxes of one frame."""

    index: int | None  # of the frame; None if the file has times only
    timestamp_ns: int | None  # of the frame; None if the file has indices only
    boxes: Boxes3D  # in the frame of reference of the file


@dataclass(frozen=True)
class Labels:
    """The contents of a file of labels.

    Attributes:
        frame_of_reference: of all boxes.
        frames: in the order of the file.
        lists_empty: frames without boxes are in the file, too. If not, a frame of the drive that the file does not
            have may be empty or not labelled.
        notes: what was assumed, for the user.
    """

    frame_of_reference: FrameOfReference
    frames: tuple[LabelledFrame, ...]
    lists_empty: bool
    notes: tuple[str, ...] = ()


def check_labels(path: Path, labels: Labels) -> Labels:
    """The labels with yaws in radians, and notes on what was assumed. Raises InputError for impossible boxes."""
    boxes = Boxes3D.concatenate([labelled.boxes for labelled in labels.frames])
    if not len(boxes):
        return labels
    longest = boxes.sizes_lwh.max(axis=1)
    if longest.max() > LONGEST_M or np.median(longest) > USUAL_M:
        unit = "centimetres" if np.median(longest) < IN_CENTIMETRES else "millimetres"
        raise InputError(
            f"{path}: has boxes of {longest.max():.0f} m, the median is {np.median(longest):.0f} m (in {unit}?): "
            "convert x, y, z, length, width and height to metres"
        )
    notes, largest = list(labels.notes), float(np.abs(boxes.yaws).max())
    if largest > LARGEST_DEGREES:
        raise InputError(f"{path}: has a yaw of {largest:g} (expected radians, or degrees up to 360): correct it")
    if largest > LARGEST_RADIANS:
        notes.append(f"the yaws, of up to {largest:.0f}, are taken to be in degrees")
        turned = [replace(each.boxes, yaws=wrap_angle(np.radians(each.boxes.yaws))) for each in labels.frames]
        frames = tuple(replace(each, boxes=of) for each, of in zip(labels.frames, turned, strict=True))
        labels = replace(labels, frames=frames)
    long = np.array([any(word in str(name).lower() for word in LONG) for name in boxes.classes])
    wider = int((boxes.sizes_lwh[long, 1] > boxes.sizes_lwh[long, 0]).sum())
    if 2 * wider > long.sum():
        notes.append(f"{wider} of {long.sum()} vehicles are wider than long: are length and width exchanged?")
    return replace(labels, notes=tuple(notes))
