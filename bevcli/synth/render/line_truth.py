"""True lines of the map around the vehicle: lane dividers, pedestrian crossings and road boundaries."""

from collections.abc import Iterable, Iterator

import numpy as np
from shapely import LineString, Polygon, box, union_all
from shapely.geometry.base import BaseGeometry
from shapely.ops import linemerge

from bevcli.frame import LINE_CLASSES, MapLines
from bevcli.geometry.transforms import Array, apply
from bevcli.synth.world.ground_plan import GroundPiece

ACROSS_M, ALONG_M = 15.0, 30.0  # half the area, from the origin of the bev frame
GAP_M = 0.05  # roads so near to each other are one
SHORTEST_M = 0.5
DIVIDER, CROSSING, BOUNDARY = LINE_CLASSES


def true_lines(pieces: Iterable[GroundPiece], bev_from_world: Array) -> MapLines:
    """The lines inside the area, bev frame. Crossings are closed; where the area cuts one, it is open."""
    around, kept = list(pieces), box(-ACROSS_M, -ALONG_M, ACROSS_M, ALONG_M)

    def moved(points: Array) -> Array:
        return apply(bev_from_world, np.pad(points, ((0, 0), (0, 1))))[:, :2]

    roads = union_all([Polygon(moved(road)).buffer(GAP_M) for piece in around for road in piece.roads]).buffer(-GAP_M)
    found = [(BOUNDARY, roads.boundary)]
    for piece in around:
        found += [(DIVIDER, LineString(moved(line))) for line in piece.lane_boundaries]
        found += [(CROSSING, Polygon(moved(outline)).boundary) for outline in piece.crossings]
    lines = [(name, part) for name, shape in found for part in _parts(shape.intersection(kept))]
    points = tuple(np.array(part.coords, dtype=np.float64) for _, part in lines)
    return MapLines(points, np.array([name for name, _ in lines], dtype=np.str_))


def _parts(shape: BaseGeometry) -> Iterator[LineString]:
    """The connected lines of a shape; lines shorter than SHORTEST_M are left out."""
    merged = linemerge(shape) if shape.geom_type == "MultiLineString" else shape
    for part in getattr(merged, "geoms", [merged]):
        if part.geom_type in ("LineString", "LinearRing") and part.length >= SHORTEST_M:
            yield part
