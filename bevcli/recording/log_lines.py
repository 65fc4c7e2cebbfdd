"""Lines on the ground, of models that have them: results such as lines of a map, and the futures of boxes."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import rerun as rr

from bevcli.frame import GroundLines, Prediction, result_of
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.object_classes import Color
from bevcli.geometry.transforms import Array, Pose, apply, inverse
from bevcli.recording import entities
from bevcli.recording.components import components, line_strips, log, ui_points
from bevcli.recording.log_boxes import box_colors
from bevcli.recording.log_cameras import PosedCamera, cut_to_images
from bevcli.recording.log_static import Recorded

FUTURES_OPACITY, FUTURES_WIDTH = 230, 1.0  # of 255; points of the user interface
ABOVE_GROUND = (0, 0, 0.04)  # metres, so that lines do not flicker with what lies on the ground


def log_results(
    stream: rr.RecordingStream, recorded: Recorded, prediction: Prediction, moved: Array, cameras: Sequence[PosedCamera]
) -> None:
    """Writes the results and futures of a model that has further results.

    moved: (4, 4) from the sequence's world into the recording's world.
    """
    score, moved_from_ego = recorded.options.score, moved @ prediction.world_from_ego.matrix
    world_from_bev = moved_from_ego @ prediction.ego_from_bev
    ground = replace(prediction.ground, world_from_ego=Pose.from_matrix(moved_from_ego))
    for kind, names in recorded.model.config.results.items():
        result = result_of(kind, prediction.results)
        lines = GroundLines() if result is None else result.drawn(ground, names, score)
        log_ground_lines(stream, kind.kind, lines, world_from_bev, cameras)
    shown = prediction.boxes.scored(score).transformed(world_from_bev)
    futures = future_lines(shown, recorded.classes)
    log_ground_lines(stream, entities.FUTURES, futures, world_from_bev, cameras)


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
            colors.append((*map(int, of_class[box][:3]), round(FUTURES_OPACITY * fading[step] * share[box, mode])))
    return GroundLines(strips, colors, FUTURES_WIDTH)


def log_ground_lines(
    stream: rr.RecordingStream, kind: str, lines: GroundLines, world_from_bev: Array, cameras: Sequence[PosedCamera]
) -> None:
    """Writes lines in the recording's world; without any, those of the frame before are cleared.

    kind: last part of their entities.
    """
    colors = np.array(lines.colors, np.uint8) if len(lines.colors) else None
    radii = ui_points(lines.width)
    points, lengths = np.concatenate([np.zeros((0, 3)), *lines.strips]), list(map(len, lines.strips))
    in_space = line_strips(points + ABOVE_GROUND, lengths)
    solid = components(rr.LineStrips3D, strips=in_space, colors=colors, radii=radii)
    log(stream, f"{entities.WORLD}/{kind}", solid)
    flat = line_strips(apply(inverse(world_from_bev), points)[:, :2] * (1, -1), lengths)
    from_above = components(rr.LineStrips2D, strips=flat, colors=colors, radii=radii, draw_order=24)
    log(stream, f"{entities.BEV}/{kind}", from_above)
    pieces = [np.stack([strip[:-1], strip[1:]], axis=1) for strip in lines.strips]
    ends = np.concatenate([np.zeros((0, 2, 3)), *pieces])
    owners = np.repeat(np.arange(len(pieces)), [len(piece) for piece in pieces])
    of_cameras = np.concatenate([apply(posed.camera_from_world, ends) for posed in cameras])
    counts = np.full(len(cameras), len(ends))
    parts = cut_to_images(of_cameras, np.tile(owners, len(cameras)), counts, cameras)
    own_colors = np.array(lines.colors, dtype=np.uint8).reshape(-1, 4)
    for posed, visible in zip(cameras, parts, strict=True):
        own = own_colors[visible.owners]
        strips = components(rr.LineStrips2D, strips=visible.segments, colors=own, radii=radii, draw_order=15)
        log(stream, entities.overlay(posed.camera.name, kind), strips)
