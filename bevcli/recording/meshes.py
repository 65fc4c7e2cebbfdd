"""The default car, and the type of all meshes. `bevcli.workshop.meshes` reads those of files."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.object_classes import Color
from bevcli.geometry.transforms import Array
from bevcli.recording.entities import EGO_COLOR

BODY_LWH = (4.6, 1.86, 0.75)
REAR_AXLE_TO_MIDDLE = 1.35  # metres ahead; the ego frame's origin is on the ground under the rear axle
WHEELBASE, TRACK = 2.75, 1.64
GLASS: Color = (32, 40, 52)
RUBBER: Color = (20, 22, 26)
OUTLINE = np.array([[3.65, -0.93], [3.65, 0.93], [-0.95, 0.93], [-0.95, -0.93], [3.65, -0.93]])  # in ego, from above
FRONT_ARROW = np.array([[2.2, -0.8], [3.3, 0.0], [2.2, 0.8]])


class Mesh(NamedTuple):
    """Triangles with colours."""

    vertices: Array  # (V, 3) metres
    normals: Array  # (V, 3) unit vectors
    faces: NDArray[np.int64]  # (F, 3) vertex indices
    colors: NDArray[np.uint8]  # (V, 3) uint8 RGB


@dataclass(frozen=True)
class VehicleMesh:
    """The ego vehicle in the ego frame."""

    mesh: Mesh  # its triangles
    # line strips (K, 2), metres: the vehicle from above, its outline and an arrow at its front
    top_view: tuple[Array, ...]


def default_vehicle() -> VehicleMesh:
    """A plain car with a cabin and four wheels, in flat shading: each corner of each triangle is a vertex of its own.

    It is made with NumPy, because trimesh would take half a second to load at the start of every run.
    """
    square = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) / 2
    cabin = _prism(square * (2.5, 1.66), 0.6)
    cabin[cabin[..., 2] > 0] *= (0.68, 0.86, 1)  # the windscreens are inclined
    turns = np.arange(20) / 20 * 2 * np.pi
    wheel = _prism(0.34 * np.stack([np.cos(turns), np.sin(turns)], -1), 0.24)[..., [1, 2, 0]]
    parts = [
        (_prism(square * BODY_LWH[:2], BODY_LWH[2]) + (REAR_AXLE_TO_MIDDLE, 0, 0.62), EGO_COLOR),
        (cabin + (1.0, 0, 1.28), GLASS),
        *((wheel + (x, y, 0.34), RUBBER) for x in (0.0, WHEELBASE) for y in (-TRACK / 2, TRACK / 2)),
    ]
    triangles = np.concatenate([part for part, _ in parts])
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    colors = np.concatenate([np.tile(color, (3 * len(part), 1)) for part, color in parts]).astype(np.uint8)
    faces = np.arange(3 * len(triangles)).reshape(-1, 3)
    mesh = Mesh(triangles.reshape(-1, 3), normals.repeat(3, axis=0), faces, colors)
    return VehicleMesh(mesh, (OUTLINE, FRONT_ARROW))


def _prism(outline: Array, height: float) -> Array:
    """A convex outline (N, 2), counter-clockwise, extruded from z = -height / 2 to height / 2.

    Returns triangles (T, 3, 3): corners in metres, counter-clockwise seen from outside.
    """
    low, high = (np.insert(outline, 2, z, axis=1) for z in (-height / 2, height / 2))
    low_next, high_next = np.roll(low, -1, axis=0), np.roll(high, -1, axis=0)
    sides = [(low, low_next, high_next), (low, high_next, high)]
    first_low, first_high = (side[:1].repeat(len(side) - 2, 0) for side in (low, high))
    caps = [(first_low, low[2:], low[1:-1]), (first_high, high[1:-1], high[2:])]  # fans
    return np.concatenate([np.stack(corners, axis=1) for corners in (*sides, *caps)])
