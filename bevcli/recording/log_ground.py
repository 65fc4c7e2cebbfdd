"""Writes lines on the ground into the scene, the BEV view and the images."""

from collections.abc import Sequence

import numpy as np
import rerun as rr

from bevcli.geometry.transforms import Array, apply, inverse
from bevcli.recording import entities
from bevcli.recording.box_lines import cut_to_image
from bevcli.recording.ground_lines import GroundLines
from bevcli.recording.log_boxes import line_strips
from bevcli.recording.log_cameras import PosedCamera

ABOVE_GROUND = (0, 0, 0.04)  # metres, so that lines do not flicker with what lies on the ground


def log_ground_lines(
    stream: rr.RecordingStream, lines: GroundLines, world_from_bev: Array, cameras: Sequence[PosedCamera]
) -> None:
    """Writes lines in the recording's world; without any, those of the frame before are cleared."""
    colors, radii = list(lines.colors) or None, rr.Radius.ui_points(lines.width)
    in_space = line_strips([strip + ABOVE_GROUND for strip in lines.strips], 3)
    stream.log(entities.ground_lines(lines.kind), rr.LineStrips3D(in_space, colors=colors, radii=radii))
    bev_from_world = inverse(world_from_bev)
    flat = line_strips([apply(bev_from_world, strip)[:, :2] * (1, -1) for strip in lines.strips], 2)
    stream.log(entities.bev_ground_lines(lines.kind), rr.LineStrips2D(flat, colors=colors, radii=radii, draw_order=24))
    for posed in cameras:
        _log_in_image(stream, lines, posed)


def _log_in_image(stream: rr.RecordingStream, lines: GroundLines, posed: PosedCamera) -> None:
    pieces = [np.stack([strip[:-1], strip[1:]], axis=1) for strip in lines.strips]
    owners = np.repeat(np.arange(len(pieces)), [len(piece) for piece in pieces])
    ends = apply(posed.camera_from_world, np.concatenate([np.zeros((0, 2, 3)), *pieces]))
    found = cut_to_image(ends, owners, posed.camera)
    colors = np.array(lines.colors, dtype=np.uint8).reshape(-1, 4)[found.owners]
    strips = rr.LineStrips2D(
        found.segments.astype(np.float32), colors=colors, radii=rr.Radius.ui_points(lines.width), draw_order=15
    )
    stream.log(entities.overlay(posed.name, lines.kind), strips)
