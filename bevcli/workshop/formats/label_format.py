"""The contents of a file of labels, and boxes that cannot be in metres and radians."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.boxes import Boxes3D

Moment = tuple[int | None, int | None]  # index and time of a frame, ns, as in LabelledFrame
LARGEST_RADIANS, LARGEST_DEGREES = 6.5, 361.0  # a little more than a turn
LONGEST_M, USUAL_M = 300.0, 30.0  # of the longest box, and of the median one; a train has 200 m
IN_CENTIMETRES = 1000.0  # a smaller median is that of boxes in centimetres


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
        states: options that state what the file holds, and their values, such as {"labels_frame": "world"}; the boxes
            decide on others.
        frames: in the order of the file.
        lists_empty: frames without boxes are in the file, too. If not, a frame of the drive that the file does not
            have may be empty or not labelled.
        notes: what was assumed, for the user.
    """

    states: Mapping[str, str]
    frames: tuple[LabelledFrame, ...]
    lists_empty: bool
    notes: tuple[str, ...] = ()


def check_labels(path: Path, labels: Labels) -> None:
    """Raise InputError for impossible boxes."""
    boxes = Boxes3D.concatenate([labelled.boxes for labelled in labels.frames])
    if not len(boxes):
        return
    longest = boxes.sizes_lwh.max(axis=1)
    if longest.max() > LONGEST_M or np.median(longest) > USUAL_M:
        unit = "centimetres" if np.median(longest) < IN_CENTIMETRES else "millimetres"
        raise InputError(
            f"{path}: has boxes of {longest.max():.0f} m, the median is {np.median(longest):.0f} m (in {unit}?): "
            "convert x, y, z, length, width and height to metres"
        )
    largest = float(np.abs(boxes.yaws).max())
    if largest > LARGEST_DEGREES:
        raise InputError(f"{path}: has a yaw of {largest:g} (expected radians, or degrees up to 360): correct it")
