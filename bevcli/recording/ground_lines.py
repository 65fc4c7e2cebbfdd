"""Lines on the ground: results of models and futures of objects, in the scene, the BEV view and the images."""

from collections.abc import Mapping, Sequence

import numpy as np
import rerun as rr

from bevcli.frame import GroundLines
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.transforms import Array, apply, inverse
from bevcli.recording import entities
from bevcli.recording.box_lines import cut_to_images
from bevcli.recording.colors import Color
from bevcli.recording.components import components, line_strips, ui_points
from bevcli.recording.log_boxes import box_colors
from bevcli.recording.log_cameras import PosedCamera
from bevcli.registry import entries

FUTURES = "futures"
OPACITY, WIDTH = 230, 1.0  # of 255; points of the user interface
ABOVE_GROUND = (0, 0, 0.04)  # metres, so that lines do not flicker with what lies on the ground


def line_kinds() -> tuple[str, ...]:
    """The last parts of the entities of lines on the ground, such as "map_lines"."""
    return (*entries("bevcli.results"), FUTURES)


def future_lines(boxes: Boxes3D, classes: Mapping[str, Color]) -> GroundLines:
    """The futures of boxes in the recording's world: colours by class, opaque by score of the mode, faded in time."""
    if boxes.futures is None or not len(boxes):
        return GroundLines()
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
            colors.append((*map(int, of_class[box][:3]), round(OPACITY * fading[step] * share[box, mode])))
    return GroundLines(strips, colors, WIDTH)


def log_ground_lines(
    stream: rr.RecordingStream, kind: str, lines: GroundLines, world_from_bev: Array, cameras: Sequence[PosedCamera]
) -> None:
    """Writes lines in the recording's world; without any, those of the frame before are cleared.

    kind: last part of their entities.
    """
    colors = np.array(lines.colors, np.uint8) if len(lines.colors) else None
    radii = ui_points(lines.width)
    in_space = line_strips([strip + ABOVE_GROUND for strip in lines.strips], 3)
    solid = components(rr.LineStrips3D, strips=in_space, colors=colors, radii=radii)
    stream.log(f"{entities.WORLD}/{kind}", solid)
    bev_from_world = inverse(world_from_bev)
    flat = line_strips([apply(bev_from_world, strip)[:, :2] * (1, -1) for strip in lines.strips], 2)
    from_above = components(rr.LineStrips2D, strips=flat, colors=colors, radii=radii, draw_order=24)
    stream.log(f"{entities.BEV}/{kind}", from_above)
    _log_in_images(stream, kind, lines, cameras)


def _log_in_images(stream: rr.RecordingStream, kind: str, lines: GroundLines, cameras: Sequence[PosedCamera]) -> None:
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
        stream.log(entities.overlay(posed.name, kind), strips)
