"""Coloured low-polygon meshes, and the primitives that they are built from.

A mesh has its own frame: x forward, y left, z up, the origin in the middle of the bottom. Lengths are in metres.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from bevcli.geometry.transforms import rigid
from bevcli.synth.assets.paint import Color, linear


class Material(IntEnum):
    """How a face is shaded. PAINT and DYE faces take the two colours of the individual."""

    MATTE = 0
    PAINT = 1
    GLASS = 2
    GLOW = 3
    GROUND = 4
    FACADE = 5
    DYE = 6
    LEAVES = 7


@dataclass(frozen=True)
class Mesh:
    """F triangles with colours.

    Attributes:
        faces: (F, 3, 3) corner points, metres; counter-clockwise seen from outside.
        albedo: (F, 3) linear RGB.
        material: (F,) values of `Material`.
    """

    faces: NDArray[np.float32]
    albedo: NDArray[np.float32]
    material: NDArray[np.uint8]

    @property
    def extents(self) -> NDArray[np.float64]:
        """(3,) length, width and height, metres."""
        points = self.faces.reshape(-1, 3).astype(np.float64)
        return points.max(0) - points.min(0)

    def fitted(self, size_lwh: ArrayLike) -> Mesh:
        """The mesh stretched to this size (3,), standing on z = 0 and centred in x and y."""
        points = self.faces.reshape(-1, 3).astype(np.float64)
        low, high = points.min(0), points.max(0)
        scale = np.asarray(size_lwh, dtype=np.float64) / (high - low)
        middle = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
        return replace(self, faces=((self.faces - middle) * scale).astype(np.float32))


def from_trimesh(shape: trimesh.Trimesh, color: Color, material: Material = Material.MATTE) -> Mesh:
    """A mesh of one colour and material."""
    faces = np.asarray(shape.triangles, dtype=np.float32)
    return Mesh(faces, np.tile(linear(color), (len(faces), 1)), np.full(len(faces), material, np.uint8))


def joined(parts: Iterable[Mesh]) -> Mesh:
    """One mesh of all parts."""
    meshes = list(parts)
    return Mesh(
        np.concatenate([m.faces for m in meshes]),
        np.concatenate([m.albedo for m in meshes]),
        np.concatenate([m.material for m in meshes]),
    )


def block(
    center: tuple[float, float, float],
    size_lwh: tuple[float, float, float],
    color: Color,
    material: Material = Material.MATTE,
) -> Mesh:
    """A cuboid. center: its middle."""
    return from_trimesh(trimesh.creation.box(size_lwh, rigid(center)), color, material)


def rod(
    start: ArrayLike,
    end: ArrayLike,
    radius: float,
    color: Color,
    material: Material = Material.MATTE,
    sections: int = 6,
) -> Mesh:
    """A cylinder between two points."""
    shape = trimesh.creation.cylinder(radius, segment=np.array([start, end], dtype=np.float64), sections=sections)
    return from_trimesh(shape, color, material)


def cone(
    x: float, y: float, bottom: float, top: float, radius: float, top_radius: float, color: Color,
    material: Material = Material.MATTE, sections: int = 8,
) -> Mesh:  # fmt: skip
    """An upright truncated cone at (x, y). bottom, top: heights; radius, top_radius: at these heights."""
    angle = np.linspace(0, 2 * np.pi, sections, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle)], -1)
    rings = [
        np.column_stack([ring * r + (x, y), np.full(sections, z)]) for r, z in ((radius, bottom), (top_radius, top))
    ]
    return loft(rings, color, material)


def ball(
    center: tuple[float, float, float],
    radii: tuple[float, float, float],
    color: Color,
    material: Material = Material.MATTE,
    subdivisions: int = 1,
) -> Mesh:
    """An ellipsoid with 20 faces; each subdivision multiplies them by 4."""
    shape = trimesh.creation.icosphere(subdivisions=subdivisions)
    shape.apply_scale(radii)
    shape.apply_translation(center)
    return from_trimesh(shape, color, material)


def loft(rings: Sequence[ArrayLike], color: Color, material: Material = Material.MATTE) -> Mesh:
    """A closed body through rings (P, 3) of equally many points, with a cap at each end.

    The end rings must be convex. The faces point outwards for both orientations of the rings.
    """
    points = np.asarray(rings, dtype=np.float64)
    count, per_ring = points.shape[:2]
    faces: list[tuple[int, int, int]] = []
    for k in range(count - 1):
        for i in range(per_ring):
            a, b = k * per_ring + i, k * per_ring + (i + 1) % per_ring
            faces += [(a, b, b + per_ring), (a, b + per_ring, a + per_ring)]
    last = (count - 1) * per_ring
    for i in range(1, per_ring - 1):
        faces += [(0, i + 1, i), (last, last + i, last + i + 1)]
    shape = trimesh.Trimesh(points.reshape(-1, 3), faces, process=False)
    if shape.volume < 0:
        shape.invert()
    sound = shape.area_faces > 1e-9
    return from_trimesh(trimesh.Trimesh(shape.vertices, shape.faces[sound], process=False), color, material)


def prism(rings: ArrayLike, color: Color) -> Mesh:
    """A faster `loft` between two horizontal rings, with the material MATTE.

    rings: (2, P, 3), the lower ring first; both convex and counter-clockwise seen from above.
    """
    lower, upper = np.asarray(rings, dtype=np.float32)
    after_lower, after_upper = np.roll(lower, -1, axis=0), np.roll(upper, -1, axis=0)
    faces = [np.stack([lower, after_lower, after_upper], 1), np.stack([lower, after_upper, upper], 1)]
    for i in range(1, len(lower) - 1):
        faces += [
            np.stack([lower[0], lower[i + 1], lower[i]])[None],
            np.stack([upper[0], upper[i], upper[i + 1]])[None],
        ]
    joint = np.concatenate(faces)
    return Mesh(joint, np.tile(linear(color), (len(joint), 1)), np.full(len(joint), Material.MATTE, np.uint8))


def side_profile(
    outline_xz: ArrayLike, half_width: float, color: Color, material: Material = Material.MATTE, y: float = 0.0,
    top_half_width: float | None = None,
) -> Mesh:  # fmt: skip
    """A convex outline (P, 2) of x and z, extruded along y around `y`.

    half_width: half the width at the bottom. top_half_width: half the width at the top; default: half_width.
    """
    outline = np.asarray(outline_xz, dtype=np.float64)
    top = half_width if top_half_width is None else top_half_width
    low, high = outline[:, 1].min(), outline[:, 1].max()
    half = half_width + (top - half_width) * (outline[:, 1] - low) / max(high - low, 1e-9)
    rings = [np.column_stack([outline[:, 0], y + side * half, outline[:, 1]]) for side in (-1, 1)]
    return loft(rings, color, material)


def wheel(x: float, y: float, radius: float, width: float, hub: Color = (122, 124, 128)) -> Mesh:
    """A tyre with a hub, standing on z = 0; its axle is parallel to y."""
    tyre = rod((x, y - width / 2, radius), (x, y + width / 2, radius), radius, (22, 22, 24), sections=12)
    rim = rod((x, y - width / 2 - 0.012, radius), (x, y + width / 2 + 0.012, radius), radius * 0.52, hub, sections=8)
    return joined([tyre, rim])
