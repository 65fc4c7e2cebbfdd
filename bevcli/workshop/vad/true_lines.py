"""True lines of the map in the area around a vehicle, cut from shapes of any source."""

from collections.abc import Iterable, Iterator

import numpy as np
from shapely import LineString, box
from shapely.geometry.base import BaseGeometry
from shapely.ops import linemerge

from bevcli.frame import MapLines

ACROSS_M, ALONG_M = 15.0, 30.0  # half the area, from the origin of the bev frame
AREA = box(-ACROSS_M, -ALONG_M, ACROSS_M, ALONG_M)
SHORTEST_M = 0.5


def lines_in_area(shapes: Iterable[tuple[str, BaseGeometry]]) -> MapLines:
    """The lines inside the area, bev frame.

    shapes: class, and lines or boundaries of polygons in the bev frame, metres. A closed line that the area cuts is
    open. Lines shorter than SHORTEST_M are left out.
    """
    lines = [(name, part) for name, shape in shapes for part in _parts(shape.intersection(AREA))]
    points = tuple(np.array(part.coords, dtype=np.float64) for _, part in lines)
    return MapLines(points, np.array([name for name, _ in lines], dtype=np.str_))


def _parts(shape: BaseGeometry) -> Iterator[LineString]:
    """The connected lines of a shape."""
    merged = linemerge(shape) if shape.geom_type == "MultiLineString" else shape
    for part in getattr(merged, "geoms", [merged]):
        if part.geom_type in ("LineString", "LinearRing") and part.length >= SHORTEST_M:
            yield part
