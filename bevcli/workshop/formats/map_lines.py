"""Lines of the map: a model's and a drive's, map_lines.json ("bevcli-map-lines/1"), their drawing, nuScenes' maps.

nuScenes' map expansion is maps/expansion/LOCATION.json below a root.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray
from shapely import GEOSException, LineString, Polygon, STRtree, box, union_all
from shapely.affinity import affine_transform
from shapely.geometry.base import BaseGeometry
from shapely.ops import linemerge

from bevcli.errors import InputError
from bevcli.frame import Frame, FrameResult, FrameStamp, Ground, GroundLines
from bevcli.geometry.object_classes import Color
from bevcli.geometry.transforms import Array, apply, inverse
from bevcli.parsing.documents import Number, read_json, typed
from bevcli.recording.entities import map_colors
from bevcli.sequences.files.incremental_json import IncrementalJson, read_frames, stamp_from_json, stamp_to_json
from bevcli.sequences.native.folder import LINES_FILE
from bevcli.workshop.formats.nuscenes_tables import read_rows

FORMAT = "bevcli-map-lines/1"
# The classes of the true lines of drives, which are those of the published VAD.
LINE_CLASSES = ("divider", "ped_crossing", "boundary")
DECIMALS = 3  # millimetres
_FRAMES_OF_REFERENCE = ("world", "ego")
# Bright, because lines of the map are thin.
LINE_COLORS: dict[str, Color] = {
    "divider": (250, 225, 120),
    "ped_crossing": (205, 140, 255),
    "boundary": (90, 225, 130),
}
OTHER_LINE_COLORS: tuple[Color, ...] = ((120, 170, 255), (255, 170, 120), (160, 235, 225), (235, 150, 205))
OPACITY, WIDTH = 230, 1.6  # of 255; points of the user interface
# True lines are cut to an area around the vehicle.
DIVIDER, CROSSING, BOUNDARY = LINE_CLASSES
LARGEST_BYTES = 256 << 20  # of a map of nuScenes
ACROSS_M, ALONG_M = 15.0, 30.0  # half the area, from the origin of the bev frame
AREA = box(-ACROSS_M, -ALONG_M, ACROSS_M, ALONG_M)
SHORTEST_M = 0.5


class LinesWriter(IncrementalJson):
    """Writes map_lines.json frame by frame, as `BoxesWriter` writes boxes. Raises OutputError."""

    def __init__(
        self, path: Path, frame_of_reference: str, extras: Mapping[str, Any], resume_at: int | None = None
    ) -> None:
        """extras: at least "classes". resume_at: `size` of an earlier writer of this file, to go on from there."""
        head = {"format": FORMAT, "frame_of_reference": frame_of_reference, **extras}
        super().__init__(path, head, "frames", resume_at)

    def write(self, ground: Ground, lines: "MapLines | None") -> None:
        """Append a frame. lines: in the bev frame; None where the model was not run."""
        entries = [] if lines is None else [_line(ground, lines, index) for index in range(len(lines))]
        self.add({**stamp_to_json(ground.stamp), "lines": entries}, f"frame {ground.stamp.index}")


def _line(ground: Ground, lines: "MapLines", index: int) -> dict[str, Any]:
    score = {} if lines.scores is None else {"score": float(lines.scores[index])}
    points = ground.points(lines.points[index]).round(DECIMALS)
    return {"class": str(lines.classes[index]), **score, "points": points.tolist()}


@dataclass(frozen=True)
class MapLines(FrameResult):
    """N lines of the map, such as lane dividers."""

    kind = "map_lines"
    file_name = "map_lines.json"
    writer = LinesWriter
    true_file = LINES_FILE
    true_names = LINE_CLASSES

    # N lines of x and y in the bev frame (P, 2), or of points on the ground in the ego or world frame (P, 3), metres; P
    # may differ
    points: tuple[Array, ...]
    classes: NDArray[np.str_]  # (N,) class names
    scores: Array | None = None  # (N,) confidence, 0 to 1. Optional

    def __len__(self) -> int:
        return len(self.points)

    @classmethod
    def legend(cls, names: tuple[str, ...]) -> dict[str, Color]:
        return {f"line: {name.replace('_', ' ')}": color for name, color in line_colors(names).items()}

    def drawn(self, ground: Ground, names: tuple[str, ...], score: float) -> GroundLines:
        colors = line_colors(names)
        scores = np.ones(len(self)) if self.scores is None else self.scores
        shown = np.flatnonzero(scores >= score)
        strips = [ground.points(self.points[index]) for index in shown]
        return GroundLines(strips, [(*colors[str(self.classes[index])], OPACITY) for index in shown], WIDTH)


def line_colors(classes: tuple[str, ...]) -> dict[str, Color]:
    """Class of lines -> colour, in the order of the classes."""
    return map_colors(classes, LINE_COLORS, OTHER_LINE_COLORS)


@dataclass(frozen=True)
class FrameLines:
    """The lines of one frame, in the frame of reference of its file."""

    stamp: FrameStamp
    lines: MapLines


@dataclass(frozen=True)
class LinesFile:
    """All frames of a file, in its order."""

    frame_of_reference: str  # "world" or "ego"; all points are in it
    classes: tuple[str, ...]  # that the lines may have
    frames: tuple[FrameLines, ...]  # the frames
    # further members of the file's JSON object, such as "model"
    extras: Mapping[str, Any] = field(default_factory=dict)


def read_lines(path: Path) -> LinesFile:
    """Read map_lines.json. Of a writer that was killed, the partial file is read.

    Raises InputError, which names the frame and the line, where the file is missing or wrong.
    """
    content = read_frames(path, FORMAT, "a file of map lines", _FRAMES_OF_REFERENCE)
    reference, classes, rows = (content.pop(key, None) for key in ("frame_of_reference", "classes", "frames"))
    frames = tuple(_frame(f"{path}: entry {index} of frames", row) for index, row in enumerate(rows))
    content.pop("format")
    return LinesFile(reference, typed(classes, tuple[str, ...], f"{path}: classes"), frames, content)


class _Line(Struct):
    name: str = msgspec.field(name="class")
    points: Annotated[list[tuple[Number, Number, Number]], Meta(min_length=2)]
    score: Annotated[float, Meta(ge=0, le=1)] | None = None


class _Lines(Struct):
    lines: list[_Line]


def _frame(where: str, row: Any) -> FrameLines:
    stamp, lines = stamp_from_json(row, where), typed(row, _Lines, where).lines
    points = tuple(np.array(line.points, dtype=np.float64) for line in lines)
    scores = [line.score for line in lines if line.score is not None]
    for index, line in enumerate(lines):
        if not np.isfinite([line.score or 0, *points[index].flat]).all():
            raise InputError(f"{where}: lines[{index}]: expected finite numbers")
        if scores and line.score is None:
            raise InputError(f"{where}: lines[{index}]: has no score, and others have one")
    classes = np.array([line.name for line in lines], dtype=np.str_)
    return FrameLines(stamp, MapLines(points, classes, np.array(scores) if scores else None))


class TrueLines:
    """The true lines of a native sequence folder: called with a frame, those in its bev frame, or None.

    The pose of the frame must be known. file: `LINES_FILE`. Raises InputError where it is wrong.
    """

    def __init__(self, file: Path) -> None:
        lines = read_lines(file)
        self._in_world = lines.frame_of_reference == "world"
        self._lines = {frame.stamp.index: frame.lines for frame in lines.frames}

    def __call__(self, frame: Frame) -> MapLines | None:
        lines = self._lines.get(frame.stamp.index)
        if lines is None:
            return None
        reference_from_ego = frame.world_from_ego.matrix if self._in_world else np.eye(4)
        bev_from_reference = inverse(reference_from_ego @ frame.rig.ego_from_bev)
        return replace(lines, points=tuple(apply(bev_from_reference, points)[:, :2] for points in lines.points))


def lines_in_area(shapes: Iterable[tuple[str, BaseGeometry]]) -> MapLines:
    """The lines inside the area, bev frame.

    shapes: class, and lines or boundaries of polygons in the bev frame, metres. A closed line that the area cuts is
    open. Lines shorter than SHORTEST_M are left out.
    """
    lines = [(name, line) for name, shape in shapes for line in _parts(shape.intersection(AREA))]
    points = tuple(np.array(line.coords, dtype=np.float64) for _, line in lines)
    return MapLines(points, np.array([name for name, _ in lines], dtype=np.str_))


def _parts(shape: BaseGeometry) -> Iterator[LineString]:
    """The connected lines of a shape."""
    merged = linemerge(shape) if shape.geom_type == "MultiLineString" else shape
    for line in getattr(merged, "geoms", [merged]):
        if line.geom_type in ("LineString", "LinearRing") and line.length >= SHORTEST_M:
            yield line


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
        lines = {row["token"]: _places(row["node_tokens"], nodes) for row in content["line"]}
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


def _places(tokens: Iterable[str], nodes: Mapping[str, tuple[float, float]]) -> list[tuple[float, float]]:
    return [nodes[token] for token in tokens]


def _polygon(row: Mapping[str, Any], nodes: Mapping[str, tuple[float, float]]) -> BaseGeometry:
    """The polygon of a row; buffer(0) mends one that crosses itself."""
    holes = [_places(hole["node_tokens"], nodes) for hole in row["holes"] if len(hole["node_tokens"]) > 2]
    shape = Polygon(_places(row["exterior_node_tokens"], nodes), holes)
    return shape if shape.is_valid else shape.buffer(0)


def _on_the_ground(transform: Array) -> Array:
    """The six numbers of `affine_transform` for places at z = 0, which maps do not state."""
    return np.concatenate([transform[:2, :2].ravel(), transform[:2, 3]])
