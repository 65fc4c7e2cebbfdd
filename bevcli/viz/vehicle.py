"""The ego vehicle as a mesh: a plain car, so that front and size are seen at a glance."""

from __future__ import annotations

import numpy as np
import trimesh

from bevcli.geometry.transforms import Array
from bevcli.viz.palette import EGO_COLOR

BODY_LWH = (4.6, 1.86, 0.75)
REAR_AXLE_TO_MIDDLE = 1.35  # metres ahead; the ego frame's origin is on the ground under the rear axle
OUTLINE = np.array([[3.65, -0.93], [3.65, 0.93], [-0.95, 0.93], [-0.95, -0.93]])  # (4, 2) in ego, seen from above


def vehicle_mesh() -> trimesh.Trimesh:
    """A car with a cabin and four wheels in the ego frame, metres, coloured by vertex."""
    body = _box(BODY_LWH, (REAR_AXLE_TO_MIDDLE, 0, 0.62), EGO_COLOR)
    cabin = _cabin()
    wheels = [_wheel(x, y) for x in (0.0, 2.75) for y in (-0.82, 0.82)]
    return trimesh.util.concatenate([body, cabin, *wheels])


def outline_and_heading() -> list[Array]:
    """The vehicle seen from above as line strips in the ego frame: its outline, and an arrow's head at the front."""
    front = np.array([[2.2, -0.8], [3.3, 0.0], [2.2, 0.8]])
    return [np.concatenate([OUTLINE, OUTLINE[:1]]), front]


def _box(size: tuple[float, float, float], middle: tuple[float, float, float], color: tuple) -> trimesh.Trimesh:
    mesh = trimesh.creation.box(extents=size)
    mesh.apply_translation(middle)
    return _colored(mesh, color)


def _cabin() -> trimesh.Trimesh:
    mesh = trimesh.creation.box(extents=(2.5, 1.66, 0.6))
    top = mesh.vertices[:, 2] > 0
    mesh.vertices[top, :2] *= (0.68, 0.86)  # windscreens lean
    mesh.apply_translation((1.0, 0, 1.28))
    return _colored(mesh, (32, 40, 52))


def _wheel(x: float, y: float) -> trimesh.Trimesh:
    mesh = trimesh.creation.cylinder(radius=0.34, height=0.24, sections=20)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0)))
    mesh.apply_translation((x, y, 0.34))
    return _colored(mesh, (20, 22, 26))


def _colored(mesh: trimesh.Trimesh, color: tuple) -> trimesh.Trimesh:
    mesh.unmerge_vertices()  # flat shading: a vertex a corner of each face
    mesh.visual.vertex_colors = np.tile([*color, 255], (len(mesh.vertices), 1)).astype(np.uint8)
    return mesh
