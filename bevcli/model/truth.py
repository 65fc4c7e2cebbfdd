"""The ground truth beyond boxes that a model with heads of its own learns from."""

from dataclasses import dataclass

from bevcli.frame import MapLines
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array


@dataclass(frozen=True)
class FrameTruth:
    """The ground truth of one frame, bev frame.

    Attributes:
        boxes: the G boxes to be found, each with one future of T steps; NaN from the step on in which the object is
            not there.
        lines: of the map.
        driven: (T, 2) places where the vehicle was at the same times, metres; NaN after the end of the scene.
        command: the driver's command that the driven path follows; "" where no place is known.
    """

    boxes: Boxes3D
    lines: MapLines
    driven: Array
    command: str
