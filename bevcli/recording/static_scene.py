"""What is the same in every frame of a recording, and is written once: rig, vehicle, range rings, colours, pillars."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr

from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.cameras import Camera, CameraRig
from bevcli.geometry.transforms import Array, apply, inverse
from bevcli.recording import entities
from bevcli.recording.colors import EGO_COLOR, RING_COLOR, class_color, colormap
from bevcli.recording.vehicle import outline_and_heading, vehicle_mesh

RING_DISTANCES_M = (10, 20, 30, 40, 50)
FRUSTUM_LENGTH_M = 0.55  # longer ones hide the vehicle from the eye behind it


def log_static(stream: rr.RecordingStream, rig: CameraRig, class_names: Sequence[str]) -> None:
    """Writes the classes' colours, the pinholes, the vehicle and the range rings."""
    stream.log(entities.WORLD, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    infos = [rr.AnnotationInfo(id=i + 1, label=n, color=class_color(n, i)) for i, n in enumerate(class_names)]
    stream.log("/", rr.AnnotationContext([rr.AnnotationInfo(id=0, label="other"), *infos]), static=True)
    for camera in rig.cameras:
        _log_pinhole(stream, camera)
    _log_vehicle(stream, rig)
    _log_rings(stream, rig)


def log_pillars(stream: rr.RecordingStream, grid: BevGrid, ego_from_bev: Array, pillars: Array) -> None:
    """Writes the 3D reference points (cells, Z, 3) of the bev frame into the scene, coloured by height."""
    points = apply(ego_from_bev, pillars).reshape(-1, 3)
    colors = pillar_colors(grid, len(pillars))
    stream.log(entities.PILLARS, rr.Points3D(points, colors=colors, radii=rr.Radius.ui_points(1.5)), static=True)


def pillar_colors(grid: BevGrid, cells: int) -> np.ndarray:
    """(cells * Z, 3) uint8, from the lowest point's colour to the highest one's."""
    heights = np.linspace(0.1, 0.95, grid.pillar_points)
    return np.tile(colormap(heights, "turbo"), (cells, 1))


def _log_pinhole(stream: rr.RecordingStream, camera: Camera) -> None:
    pinhole = rr.Pinhole(
        image_from_camera=camera.intrinsics,
        resolution=[camera.width, camera.height],
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=FRUSTUM_LENGTH_M,
        color=[*EGO_COLOR, 160],
        line_width=0.01,
    )
    stream.log(entities.camera(camera.name), pinhole, static=True)


def _log_vehicle(stream: rr.RecordingStream, rig: CameraRig) -> None:
    mesh = vehicle_mesh()
    archetype = rr.Mesh3D(
        vertex_positions=mesh.vertices,
        triangle_indices=mesh.faces,
        vertex_normals=mesh.normals,
        vertex_colors=mesh.colors,
    )
    stream.log(entities.VEHICLE, archetype, static=True)
    strips = [_seen_from_above(rig, strip) for strip in outline_and_heading()]
    stream.log(entities.BEV_VEHICLE, rr.LineStrips2D(strips, colors=EGO_COLOR, draw_order=40), static=True)


def _log_rings(stream: rr.RecordingStream, rig: CameraRig) -> None:
    angles = np.linspace(0, 2 * np.pi, 121)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    rings = [circle * distance for distance in RING_DISTANCES_M]
    width = rr.Radius.ui_points(0.6)
    in_space = [np.column_stack([ring, np.zeros(len(ring))]) for ring in rings]
    stream.log(entities.RANGE_RINGS, rr.LineStrips3D(in_space, colors=[*RING_COLOR, 140], radii=width), static=True)
    flat = [_seen_from_above(rig, ring) for ring in rings]
    stream.log(entities.BEV_RINGS, rr.LineStrips2D(flat, colors=RING_COLOR, radii=width, draw_order=5), static=True)
    # Labels stand on the circles, ahead to the right, where they cover little.
    places = [_seen_from_above(rig, ring[[105]])[0] for ring in rings]
    labels = rr.Points2D(
        places,
        labels=[f"{distance} m" for distance in RING_DISTANCES_M],
        colors=[150, 156, 170],
        radii=rr.Radius.ui_points(0.01),
        show_labels=True,
        draw_order=6,
    )
    stream.log(f"{entities.BEV_RINGS}/labels", labels, static=True)


def _seen_from_above(rig: CameraRig, points_ego: Array) -> Array:
    """Points (K, 2) on the ground in ego -> (K, 2) of the flat bev image: x to the right, -y down."""
    points = apply(inverse(rig.ego_from_bev), np.column_stack([points_ego, np.zeros(len(points_ego))]))
    return points[:, :2] * (1, -1)
