"""Coloured low-polygon meshes, and the primitives that they are built from.

A mesh has its own frame: x forward, y left, z up, the origin in the middle of the bottom. Lengths are in metres.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from bevcli.geometry.transforms import rigid
from bevcli.synth.assets.paint import Color, Finish, Surface, linear

Point = tuple[float, float, float]  # x, y, z, metres


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

    def fitted(self, size_lwh: ArrayLike) -> "Mesh":
        """The mesh stretched to this size (3,), standing on z = 0 and centred in x and y."""
        points = self.faces.reshape(-1, 3).astype(np.float64)
        low, high = points.min(0), points.max(0)
        scale = np.asarray(size_lwh, dtype=np.float64) / (high - low)
        middle = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
        return replace(self, faces=((self.faces - middle) * scale).astype(np.float32))


def from_faces(faces: ArrayLike, surface: Surface) -> Mesh:
    """A mesh of faces (F, 3, 3) with one surface."""
    corners = np.asarray(faces, dtype=np.float32)
    color, material = surface if isinstance(surface, Finish) else Finish(surface)
    return Mesh(corners, np.tile(linear(color), (len(corners), 1)), np.full(len(corners), material, np.uint8))


def joined(parts: Iterable[Mesh]) -> Mesh:
    """One mesh of all parts."""
    faces, albedo, material = zip(*((part.faces, part.albedo, part.material) for part in parts), strict=True)
    return Mesh(np.concatenate(faces), np.concatenate(albedo), np.concatenate(material))


def block(center: Point, size_lwh: Point, surface: Surface) -> Mesh:
    """A cuboid. center: its middle."""
    return from_faces(trimesh.creation.box(size_lwh, rigid(center)).triangles, surface)


def rod(start: ArrayLike, end: ArrayLike, radius: float, surface: Surface, sections: int = 6) -> Mesh:
    """A cylinder between two points."""
    shape = trimesh.creation.cylinder(radius, segment=np.array([start, end], dtype=np.float64), sections=sections)
    return from_faces(shape.triangles, surface)


def crossbar(x: float, z: float, half: float, radius: float, surface: Surface, sections: int = 6) -> Mesh:
    """A cylinder along y about (x, 0, z). half: half its length."""
    return rod((x, -half, z), (x, half, z), radius, surface, sections)


def cone(bottom: float, top: float, radius: float, top_radius: float, surface: Surface, sections: int = 8) -> Mesh:
    """An upright truncated cone at x = y = 0. bottom, top: heights; radius, top_radius: at these heights."""
    angle = np.linspace(0, 2 * np.pi, sections, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle)], -1)
    rings = [np.column_stack([ring * r, np.full(sections, z)]) for r, z in ((radius, bottom), (top_radius, top))]
    return loft(rings, surface)


def ball(center: Point, radii: Point, surface: Surface, subdivisions: int = 1) -> Mesh:
    """An ellipsoid with 20 faces; each subdivision multiplies them by 4."""
    shape = trimesh.creation.icosphere(subdivisions=subdivisions)
    shape.apply_scale(radii)
    shape.apply_translation(center)
    return from_faces(shape.triangles, surface)


def loft(rings: Sequence[ArrayLike], surface: Surface) -> Mesh:
    """A closed body through rings (P, 3) of equally many points, with a cap at each end.

    The end rings must be convex. The faces point outwards for both orientations of the rings.
    """
    points = np.asarray(rings, dtype=np.float64)
    count = points.shape[1]
    last = (len(points) - 1) * count
    faces: list[tuple[int, int, int]] = []
    for a in range(last):
        b = a + 1 if (a + 1) % count else a + 1 - count  # the next point of the ring
        faces += [(a, b, b + count), (a, b + count, a + count)]
    for i in range(1, count - 1):
        faces += [(0, i + 1, i), (last, last + i, last + i + 1)]
    shape = trimesh.Trimesh(points.reshape(-1, 3), faces, process=False)
    if shape.volume < 0:
        shape.invert()
    return from_faces(shape.triangles[shape.area_faces > 1e-9], surface)


def prism(rings: ArrayLike, surface: Surface) -> Mesh:
    """A faster `loft` between two horizontal rings.

    rings: (2, P, 3), the lower ring first; both convex and counter-clockwise seen from above.
    """
    points = np.asarray(rings, dtype=np.float32)
    count = points.shape[1]
    following = [(i, (i + 1) % count) for i in range(count)]
    faces = [(i, j, j + count) for i, j in following] + [(i, j + count, i + count) for i, j in following]
    for i in range(1, count - 1):
        faces += [(0, i + 1, i), (count, count + i, count + i + 1)]
    return from_faces(points.reshape(-1, 3)[faces], surface)


def side_profile(
    outline_xz: ArrayLike, half_width: float, surface: Surface, y: float = 0.0,
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
    return loft(rings, surface)


def wheel(x: float, y: float, radius: float, width: float, hub: Color = (122, 124, 128)) -> Mesh:
    """A tyre with a hub, standing on z = 0; its axle is parallel to y."""
    tyre = rod((x, y - width / 2, radius), (x, y + width / 2, radius), radius, (22, 22, 24), sections=12)
    rim = rod((x, y - width / 2 - 0.012, radius), (x, y + width / 2 + 0.012, radius), radius * 0.52, hub, sections=8)
    return joined([tyre, rim])
