"""Lines on the ground: of the map, futures of objects and planned paths, in the scene, the BEV view and the images."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import rerun as rr

from bevcli.frame import FrameResult, Ground, MapLines, Plan
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array, apply, inverse
from bevcli.recording import entities
from bevcli.recording.box_lines import cut_to_images
from bevcli.recording.colors import EGO_COLOR, Color, line_colors
from bevcli.recording.components import components, line_strips, ui_points
from bevcli.recording.log_boxes import box_colors
from bevcli.recording.log_cameras import PosedCamera

FUTURES = "futures"
MAP_LINE_WIDTH, FUTURE_WIDTH, PATH_WIDTH = 1.6, 1.0, 1.2  # points of the user interface
OPAQUE, FAINT = 230, 45  # of 255
HALF_VEHICLE_M = 0.925
RUNG_M = 0.4  # of a ribbon
ABOVE_GROUND = (0, 0, 0.04)  # metres, so that lines do not flicker with what lies on the ground
Color4 = tuple[int, int, int, int]


@dataclass(frozen=True)
class GroundLines:
    """Lines on the ground, all of one kind.

    Attributes:
        kind: last part of their entities, such as "map_lines".
        strips: N lines (K, 3) in the recording's world, metres.
        colors: N colours, RGB and opacity.
        width: in points of the user interface.
    """

    kind: str
    strips: Sequence[Array] = ()
    colors: Sequence[Color4] = ()
    width: float = 1.0


def future_lines(boxes: Boxes3D, classes: Mapping[str, Color]) -> GroundLines:
    """The futures of boxes in the recording's world: colours by class, opaque by score of the mode, faded in time."""
    if boxes.futures is None or not len(boxes):
        return GroundLines(FUTURES)
    feet = boxes.centers[:, 2] - boxes.sizes_lwh[:, 2] / 2
    places = np.concatenate([np.broadcast_to(boxes.centers[:, None, None, :2], (*boxes.futures.shape[:2], 1, 2)),
                             boxes.futures[..., 1:]], axis=2)  # (N, M, T + 1, 2)  # fmt: skip
    heights = np.broadcast_to(feet[:, None, None, None], (*places.shape[:3], 1))
    steps = np.concatenate([places, heights], axis=-1)
    modes = np.ones(boxes.futures.shape[:2]) if boxes.future_scores is None else boxes.future_scores
    share = modes / np.maximum(modes.max(1, keepdims=True), 1e-9)  # (N, M)
    fading = np.linspace(1, 0.25, boxes.futures.shape[2])
    strips, colors, of_class = [], [], box_colors(boxes, classes)
    for box, mode, step in np.ndindex(*boxes.futures.shape[:3]):
        piece = steps[box, mode, step : step + 2]
        if np.isfinite(piece).all():
            strips.append(piece)
            colors.append((*map(int, of_class[box][:3]), round(OPAQUE * fading[step] * share[box, mode])))
    return GroundLines(FUTURES, strips, colors, FUTURE_WIDTH)


def _map_lines(lines: MapLines, ground: Ground, names: tuple[str, ...], score: float) -> GroundLines:
    colors = line_colors(names)
    scores = np.ones(len(lines)) if lines.scores is None else lines.scores
    shown = np.flatnonzero(scores >= score)
    strips = [ground.points(lines.points[place]) for place in shown]
    of_class = [(*colors[str(lines.classes[place])], OPAQUE) for place in shown]
    return GroundLines("map_lines", strips, of_class, MAP_LINE_WIDTH)


def _plan(plan: Plan, ground: Ground, names: tuple[str, ...], score: float) -> GroundLines:
    """Each path as a line, and the one of the command as a ribbon as wide as the vehicle."""
    strips, colors = [], []
    for command, path in zip(plan.commands, plan.paths, strict=True):
        whole = np.concatenate([np.zeros((1, 2)), path])
        ribbon = list(_ribbon(whole)) if command == plan.command else []
        strips += [ground.points(line) for line in (*ribbon, whole)]
        colors += [(*EGO_COLOR, FAINT if len(line) == 2 else OPAQUE) for line in ribbon]
        colors.append((*EGO_COLOR, OPAQUE if ribbon else 2 * FAINT))
    return GroundLines("plan", strips, colors, PATH_WIDTH)


def _ribbon(path: Array) -> Iterator[Array]:
    """The two sides of a ribbon along a path (K, 2), and its rungs."""
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    if along[-1] < RUNG_M:
        return
    at = np.linspace(0, along[-1], int(along[-1] / RUNG_M) + 2)
    middle = np.stack([np.interp(at, along, axis) for axis in path.T], axis=-1)
    ahead = np.gradient(middle, axis=0)
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
    across = HALF_VEHICLE_M * np.stack([ahead[:, 1], -ahead[:, 0]], axis=-1)
    yield from (middle - across, middle + across)
    yield from np.stack([middle - across, middle + across], axis=1)


Drawing = Callable[[Any, Ground, tuple[str, ...], float], GroundLines]
_DRAWINGS: Mapping[type[FrameResult], tuple[str, Drawing]] = {
    MapLines: ("map_lines", _map_lines),
    Plan: ("plan", _plan),
}
KINDS = (*(kind for kind, _ in _DRAWINGS.values()), FUTURES)


def result_lines(
    results: Sequence[FrameResult],
    ground: Ground,
    names: Mapping[type[FrameResult], tuple[str, ...]],
    score: float,
) -> Iterator[GroundLines]:
    """The lines of each kind of results that a model has; none for a kind that this frame lacks.

    names: of the kinds, `ModelConfig.results`. score: lines of the map below it are left out.
    """
    for kind, of_kind in names.items():
        name, draw = _DRAWINGS[kind]
        found = next((result for result in results if isinstance(result, kind)), None)
        yield GroundLines(name) if found is None else draw(found, ground, of_kind, score)


def log_ground_lines(
    stream: rr.RecordingStream, lines: GroundLines, world_from_bev: Array, cameras: Sequence[PosedCamera]
) -> None:
    """Writes lines in the recording's world; without any, those of the frame before are cleared."""
    colors = np.array(lines.colors, np.uint8) if len(lines.colors) else None
    radii = ui_points(lines.width)
    in_space = line_strips([strip + ABOVE_GROUND for strip in lines.strips], 3)
    solid = components(rr.LineStrips3D, strips=in_space, colors=colors, radii=radii)
    stream.log(f"{entities.WORLD}/{lines.kind}", solid)
    bev_from_world = inverse(world_from_bev)
    flat = line_strips([apply(bev_from_world, strip)[:, :2] * (1, -1) for strip in lines.strips], 2)
    from_above = components(rr.LineStrips2D, strips=flat, colors=colors, radii=radii, draw_order=24)
    stream.log(f"{entities.BEV}/{lines.kind}", from_above)
    _log_in_images(stream, lines, cameras)


def _log_in_images(stream: rr.RecordingStream, lines: GroundLines, cameras: Sequence[PosedCamera]) -> None:
    pieces = [np.stack([strip[:-1], strip[1:]], axis=1) for strip in lines.strips]
    ends = np.concatenate([np.zeros((0, 2, 3)), *pieces])
    owners = np.repeat(np.arange(len(pieces)), [len(piece) for piece in pieces])
    of_cameras = np.concatenate([apply(posed.camera_from_world, ends) for posed in cameras])
    counts = np.full(len(cameras), len(ends))
    parts = cut_to_images(of_cameras, np.tile(owners, len(cameras)), counts, [posed.camera for posed in cameras])
    own_colors, radii = np.array(lines.colors, dtype=np.uint8).reshape(-1, 4), ui_points(lines.width)
    for posed, found in zip(cameras, parts, strict=True):
        colors = own_colors[found.owners]
        strips = components(rr.LineStrips2D, strips=found.segments, colors=colors, radii=radii, draw_order=15)
        stream.log(entities.overlay(posed.name, lines.kind), strips)
