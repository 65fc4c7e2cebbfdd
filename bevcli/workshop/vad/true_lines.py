"""True lines of the map in the area around a vehicle: cut from shapes of any source, and those of nuScenes' maps.

nuScenes' map expansion is maps/expansion/LOCATION.json below a root.
"""

from collections.abc import Iterable, Iterator, Mapping
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from shapely import GEOSException, LineString, Polygon, STRtree, box, union_all
from shapely.affinity import affine_transform
from shapely.geometry.base import BaseGeometry
from shapely.ops import linemerge

from bevcli.errors import InputError
from bevcli.frame import Frame
from bevcli.geometry.transforms import Array, inverse
from bevcli.parsing.documents import read_json
from bevcli.sequences.nuscenes.tables import read_rows
from bevcli.workshop.vad.map_lines import LINE_CLASSES, MapLines

DIVIDER, CROSSING, BOUNDARY = LINE_CLASSES
LARGEST_BYTES = 256 << 20
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


class MapExpansion:
    """The maps of a nuScenes root: called with a frame, the lines in its bev frame; None without the location's map.

    Each map is read when a scene needs it. Raises InputError where a file is wrong.

    Args:
        folder: maps/expansion.
        tables: the folder with scene.json and log.json, which say where a scene was driven.
    """

    def __init__(self, folder: Path, tables: Path) -> None:
        self.folder, self.tables = folder, tables
        self._map = lru_cache(maxsize=1)(read_map)

    def __call__(self, frame: Frame) -> MapLines | None:
        file = self.folder / f"{self._locations.get(frame.stamp.scene)}.json"
        bev_from_world = inverse(frame.world_from_ego.matrix @ frame.rig.ego_from_bev)
        return lines_around(self._map(file), bev_from_world) if file.is_file() else None

    @cached_property
    def _locations(self) -> Mapping[str, str]:
        """Name of a scene -> its location, such as "boston-seaport"."""
        scenes = read_rows(self.tables / "scene.json")
        locations = read_rows(self.tables / "log.json").by_token("location")
        pairs = zip(scenes.texts("name"), scenes.texts("log_token"), strict=True)
        return {name: locations[log] for name, log in pairs if log in locations}


def lines_around(shapes: Mapping[str, STRtree], bev_from_world: Array) -> MapLines:
    """The lines of `lines_in_area`. Crossings that touch are one; boundaries are those of all roads together."""
    area = affine_transform(AREA, _on_the_ground(inverse(bev_from_world)))
    near_shapes: list[tuple[str, BaseGeometry]] = []
    for name, tree in shapes.items():
        near = list(tree.geometries[tree.query(area, predicate="intersects")])
        if name == DIVIDER or not near:
            near_shapes += [(name, line) for line in near]
        else:
            near_shapes.append((name, union_all(near).boundary))
    return lines_in_area((name, affine_transform(shape, _on_the_ground(bev_from_world))) for name, shape in near_shapes)


def read_map(file: Path) -> dict[str, STRtree]:
    """Read the map of one location (versions 1.0 to 1.3). Raises InputError.

    Returns, by class of lines, search trees of shapes in the world frame: lines between lanes and between directions,
    and polygons of pedestrian crossings and of roads.
    """
    content = read_json(file, largest=LARGEST_BYTES)
    try:
        nodes = {row["token"]: (float(row["x"]), float(row["y"])) for row in content["node"]}
        lines = {row["token"]: _points(row["node_tokens"], nodes) for row in content["line"]}
        polygons = {row["token"]: _polygon(row, nodes) for row in content["polygon"]}
        dividers = [lines[row["line_token"]] for name in ("lane_divider", "road_divider") for row in content[name]]
        shapes = {
            name: [polygons[row["polygon_token"]] for row in content[name]]
            for name in ("ped_crossing", "road_segment", "lane")
        }
        return {
            DIVIDER: STRtree([LineString(points) for points in dividers if len(points) > 1]),
            CROSSING: STRtree(shapes["ped_crossing"]),
            BOUNDARY: STRtree(shapes["road_segment"] + shapes["lane"]),
        }
    except (KeyError, TypeError, ValueError, GEOSException) as error:
        raise InputError(
            f"{file}: {error!r:.80} (expected a map of nuScenes' map expansion): download it again"
        ) from None


def _points(tokens: Iterable[str], nodes: Mapping[str, tuple[float, float]]) -> list[tuple[float, float]]:
    return [nodes[token] for token in tokens]


def _polygon(row: Mapping[str, Any], nodes: Mapping[str, tuple[float, float]]) -> BaseGeometry:
    """The polygon of a row; buffer(0) mends one that crosses itself."""
    holes = [_points(hole["node_tokens"], nodes) for hole in row["holes"] if len(hole["node_tokens"]) > 2]
    shape = Polygon(_points(row["exterior_node_tokens"], nodes), holes)
    return shape if shape.is_valid else shape.buffer(0)


def _on_the_ground(transform: Array) -> Array:
    """The six numbers of `affine_transform` for places at z = 0, which maps do not state."""
    return np.concatenate([transform[:2, :2].ravel(), transform[:2, 3]])
