"""The contents of a file of labels."""

from dataclasses import dataclass
from typing import Literal

from bevcli.geometry.boxes import Boxes3D

FrameOfReference = Literal["world", "ego", "bev"]
Moment = tuple[int | None, int | None]  # index and time of a frame, ns, as in LabelledFrame


@dataclass(frozen=True)
class LabelledFrame:
    """The boxes of one frame.

    Attributes:
        index: of the frame; None if the file has times only.
        timestamp_ns: of the frame; None if the file has indices only.
        boxes: in the frame of reference of the file.
    """

    index: int | None
    timestamp_ns: int | None
    boxes: Boxes3D


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
