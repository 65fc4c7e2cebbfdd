"""True lines of the map around the vehicle: lane dividers, pedestrian crossings and road boundaries."""

from collections.abc import Iterable

import numpy as np
from shapely import LineString, Polygon, union_all
from shapely.geometry.base import BaseGeometry

from bevcli.frame import LINE_CLASSES, MapLines
from bevcli.geometry.transforms import Array, apply
from bevcli.sequences.true_lines import lines_in_area
from bevcli.synth.world.ground_plan import GroundPiece

GAP_M = 0.05  # roads so near to each other are one
DIVIDER, CROSSING, BOUNDARY = LINE_CLASSES


def true_lines(pieces: Iterable[GroundPiece], bev_from_world: Array) -> MapLines:
    """The lines of `lines_in_area`, bev frame. Crossings are closed."""
    around = list(pieces)

    def moved(points: Array) -> Array:
        return apply(bev_from_world, np.pad(points, ((0, 0), (0, 1))))[:, :2]

    roads = union_all([Polygon(moved(road)).buffer(GAP_M) for piece in around for road in piece.roads]).buffer(-GAP_M)
    found: list[tuple[str, BaseGeometry]] = [(BOUNDARY, roads.boundary)]
    for piece in around:
        found += [(DIVIDER, LineString(moved(line))) for line in piece.lane_boundaries]
        found += [(CROSSING, Polygon(moved(outline)).boundary) for outline in piece.crossings]
    return lines_in_area(found)
