"""The weights of VAD's losses."""

from dataclasses import astuple, dataclass


@dataclass(frozen=True)
class LossWeights:
    """The [loss_weights] table: weights of the losses of lines, futures and paths. Defaults: as published (stage 2).

    Attributes:
        line_class: of the focal loss of the lines' classes; also of their cost in the matching.
        line_points: of the L1 loss of the lines' points, summed, as shares of the range; also of their cost.
        line_direction: of 1 minus the cosine between the segments of a line and the true ones.
        future: of the L1 loss of the movements in the best mode of an object.
        mode: of the focal loss of the modes.
        plan: of the L1 loss of the movements of the vehicle.
        boundary: of the shares of a metre by which planned places are nearer than that to a boundary.
        collision: of the metres by which planned places are too near to vehicles.
        direction: of the angle between the planned path and the nearest divider, radians.
    """

    line_class: float = 0.8
    line_points: float = 0.4
    line_direction: float = 0.005
    future: float = 0.2
    mode: float = 0.2
    plan: float = 1.0
    boundary: float = 1.0
    collision: float = 1.0
    direction: float = 0.5

    def __post_init__(self) -> None:
        if min(astuple(self)) < 0:
            raise ValueError("the weights must not be negative")
