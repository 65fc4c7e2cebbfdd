"""The ego vehicle as a mesh: a plain car, so that front and size are seen at a glance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.transforms import Array
from bevcli.recording.colors import EGO_COLOR, Color

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
    body = _box(*BODY_LWH) + (REAR_AXLE_TO_MIDDLE, 0, 0.62)
    wheels = [_wheel() + (x, y, 0.34) for x in (0.0, WHEELBASE) for y in (-TRACK / 2, TRACK / 2)]
    return _joined([(body, EGO_COLOR), (_cabin(), GLASS), *((wheel, RUBBER) for wheel in wheels)])


def outline_and_heading() -> list[Array]:
    """The vehicle seen from above as line strips in the ego frame: its outline, and an arrow's head at the front."""
    front = np.array([[2.2, -0.8], [3.3, 0.0], [2.2, 0.8]])
    return [np.concatenate([OUTLINE, OUTLINE[:1]]), front]


# Parts are triangles, (T, 3, 3): corners in metres, counter-clockwise seen from outside. They are this plain because
# trimesh takes half a second to load, at the start of every run.


def _cabin() -> Array:
    cabin = _box(2.5, 1.66, 0.6)
    cabin[cabin[..., 2] > 0] *= (0.68, 0.86, 1)  # windscreens lean
    return cabin + (1.0, 0, 1.28)


def _wheel(radius: float = 0.34, width: float = 0.24, sections: int = 20) -> Array:
    turns = np.arange(sections) / sections * 2 * np.pi
    standing = _prism(radius * np.stack([np.cos(turns), np.sin(turns)], -1), width)
    return standing[..., [1, 2, 0]]


def _box(length: float, width: float, height: float) -> Array:
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) / 2
    return _prism(corners * (length, width), height)


def _prism(outline: Array, height: float) -> Array:
    """A convex outline (N, 2), counter-clockwise, from z = -height / 2 to height / 2."""
    low, high = (np.insert(outline, 2, z, axis=1) for z in (-height / 2, height / 2))
    low_next, high_next = np.roll(low, -1, axis=0), np.roll(high, -1, axis=0)
    sides = [(low, low_next, high_next), (low, high_next, high)]
    caps = [(low[:1].repeat(len(low), 0), low_next, low), (high[:1].repeat(len(high), 0), high, high_next)]
    triangles = np.concatenate([np.stack(corners, axis=1) for corners in (*sides, *caps)])
    return triangles[np.linalg.norm(_normals(triangles), axis=-1) > 0]  # a cap's fan begins and ends in a line


def _normals(triangles: Array) -> Array:
    return np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])


def _joined(parts: list[tuple[Array, Color]]) -> ColoredMesh:
    """Flat shading: a vertex for each corner of each triangle."""
    triangles = np.concatenate([part for part, _ in parts])
    normals = _normals(triangles)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return ColoredMesh(
        vertices=triangles.reshape(-1, 3),
        normals=normals.repeat(3, axis=0),
        faces=np.arange(3 * len(triangles)).reshape(-1, 3),
        colors=np.concatenate([np.tile(color, (3 * len(part), 1)) for part, color in parts]).astype(np.uint8),
    )
