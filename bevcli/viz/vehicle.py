"""The ego vehicle as a mesh: a plain car, so that front and size are seen at a glance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray

from bevcli.geometry.transforms import Array
from bevcli.viz.palette import EGO_COLOR, Color

BODY_LWH = (4.6, 1.86, 0.75)
REAR_AXLE_TO_MIDDLE = 1.35  # metres ahead; the ego frame's origin is on the ground under the rear axle
WHEELBASE, TRACK = 2.75, 1.64
GLASS: Color = (32, 40, 52)
RUBBER: Color = (20, 22, 26)
OUTLINE = np.array([[3.65, -0.93], [3.65, 0.93], [-0.95, 0.93], [-0.95, -0.93]])  # (4, 2) in ego, seen from above


@dataclass(frozen=True)
class ColoredMesh:
    """vertices: (V, 3) metres. normals: (V, 3). faces: (F, 3) vertex indices. colors: (V, 3) uint8 RGB."""

    vertices: Array
    normals: Array
    faces: NDArray[np.int64]
    colors: NDArray[np.uint8]


def vehicle_mesh() -> ColoredMesh:
    """A car with a cabin and four wheels in the ego frame."""
    body = trimesh.creation.box(extents=BODY_LWH)
    body.apply_translation((REAR_AXLE_TO_MIDDLE, 0, 0.62))
    wheels = [_wheel(x, y) for x in (0.0, WHEELBASE) for y in (-TRACK / 2, TRACK / 2)]
    return _joined([(body, EGO_COLOR), (_cabin(), GLASS), *((wheel, RUBBER) for wheel in wheels)])


def outline_and_heading() -> list[Array]:
    """The vehicle seen from above as line strips in the ego frame: its outline, and an arrow's head at the front."""
    front = np.array([[2.2, -0.8], [3.3, 0.0], [2.2, 0.8]])
    return [np.concatenate([OUTLINE, OUTLINE[:1]]), front]


def _cabin() -> trimesh.Trimesh:
    mesh = trimesh.creation.box(extents=(2.5, 1.66, 0.6))
    top = mesh.vertices[:, 2] > 0
    mesh.vertices[top, :2] *= (0.68, 0.86)  # windscreens lean
    mesh.apply_translation((1.0, 0, 1.28))
    return mesh


def _wheel(x: float, y: float) -> trimesh.Trimesh:
    mesh = trimesh.creation.cylinder(radius=0.34, height=0.24, sections=20)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0)))
    mesh.apply_translation((x, y, 0.34))
    return mesh


def _joined(parts: list[tuple[trimesh.Trimesh, Color]]) -> ColoredMesh:
    for mesh, _ in parts:
        mesh.unmerge_vertices()  # flat shading: a vertex for each corner of each face
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh, _ in parts)])
    return ColoredMesh(
        vertices=np.concatenate([mesh.vertices for mesh, _ in parts]),
        normals=np.concatenate([mesh.vertex_normals for mesh, _ in parts]),
        faces=np.concatenate([mesh.faces + start for (mesh, _), start in zip(parts, starts, strict=False)]),
        colors=np.concatenate([np.tile(color, (len(mesh.vertices), 1)) for mesh, color in parts]).astype(np.uint8),
    )
