"""Dialect: the differences between the formats that use nuScenes' tables."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from bevcli.geometry.transforms import Array
from bevcli.sequences.nuscenes.index import CLASS_OF_CATEGORY


@dataclass(frozen=True)
class Dialect:
    """The reading of tables that differ from nuScenes' own in some points.

    Attributes:
        lidars: channels of which each sample has a keyframe, whose ego pose is that of the frame.
        class_of: a category -> its class, None for a category that is left out.
        visibilities: names of visibility levels -> visible fraction, besides names such as "v40-60".
        has_attributes: whether the attributes are those of nuScenes, which are scored.
        ego_from_bev: (4, 4) metres; None for the frame of the lidar.
    """

    lidars: tuple[str, ...]
    class_of: Callable[[str], str | None]
    visibilities: Mapping[str, float] = field(default_factory=dict)
    has_attributes: bool = True
    ego_from_bev: Array | None = None


# The published models predict in the frame of LIDAR_TOP.
NUSCENES = Dialect(("LIDAR_TOP",), CLASS_OF_CATEGORY.get)
