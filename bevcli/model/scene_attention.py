"""SceneAttention: the weights with which a part of a model attends to the objects and the lines of a scene."""

from dataclasses import dataclass

from bevcli.frame import MapLines
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array


@dataclass(frozen=True)
class SceneAttention:
    """Attention to Q objects and N lines, the mean over heads. Places are in metres, bev frame.

    Attributes:
        objects: one box for each object query, with its best class.
        object_weights: (Q,), which sum to 1.
        lines: of all line queries, each with its best class.
        line_weights: (N,), which sum to 1 together with `no_line`.
        paths: (K, T + 1, 2), that come of the attention: planned paths, or futures of the attending object.
        best: index of the path that counts; None where it is not known.
        no_line: weight of the entry that stands for no line; 0 for a part without one.
        attending: index of the object that attends; None for the own vehicle.
    """

    objects: Boxes3D
    object_weights: Array
    lines: MapLines
    line_weights: Array
    paths: Array
    best: int | None = None
    no_line: float = 0.0
    attending: int | None = None
