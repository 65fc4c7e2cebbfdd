"""Coloured low-polygon meshes: what they are made of, the primitives that build them, and meshes placed in the world.

A mesh has its own frame: x forward, y left, z up, the origin in the middle of the bottom. Lengths are in metres.
Colours are chosen in sRGB; light is computed in linear RGB.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from enum import IntEnum
from typing import Any, NamedTuple, Self

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from bevcli.geometry.transforms import rigid

Color = tuple[int, int, int]  # sRGB, 0 to 255


class Material(IntEnum):
    """Kind of shading of a face. PAINT and DYE faces take the two colours of the individual."""

    MATTE = 0
    PAINT = 1
    GLASS = 2
    GLOW = 3
    GROUND = 4
    FACADE = 5
    DYE = 6
    LEAVES = 7


class Finish(NamedTuple):
    """The colour and the material of a surface."""

    color: Color  # sRGB. That of PAINT and DYE is a placeholder.
    material: Material = Material.MATTE  # kind of shading


Surface = Color | Finish  # a colour alone is matte

# Parts of vehicles.
PAINT = Finish((200, 200, 200), Material.PAINT)
DYED_PAINT = Finish((200, 200, 200), Material.DYE)
CARGO = Finish((224, 224, 220), Material.DYE)
GLASS = Finish((38, 48, 56), Material.GLASS)
TRIM: Color = (34, 35, 38)
HEADLAMP = Finish((255, 248, 226), Material.GLOW)
TAIL_LAMP = Finish((190, 16, 18), Material.GLOW)


def linear(color: ArrayLike) -> NDArray[np.float32]:
    """Convert sRGB (..., 3), 0 to 255, to linear RGB (..., 3), 0 to 1."""
    c = np.asarray(color, dtype=np.float64) / 255
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4).astype(np.float32)


Point = tuple[float, float, float]  # x, y, z, metres
NO_FACADES = np.zeros((0, 16), np.float32)
Row = tuple[Any, ...]  # of a table of parts: the function that makes a part, and its arguments


@dataclass(frozen=True)
class Mesh:
    """F triangles with colours."""

    faces: NDArray[np.float32]  # (F, 3, 3) corner points, metres; counter-clockwise seen from outside
    albedo: NDArray[np.float32]  # (F, 3) linear RGB
    material: NDArray[np.uint8]  # (F,) values of `Material`

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


@dataclass(frozen=True)
class TriangleSoup:
    """T triangles of M meshes in the world frame, each mesh a range that the rasteriser can skip as a whole.

    A soup of one mesh in its own frame is a template: its normals and its sphere are computed once, and it is placed
    many times.
    """

    corners: NDArray[np.float32]  # (T, 3, 3) corner points, metres; counter-clockwise seen from outside
    normals: NDArray[np.float32]  # (T, 3) unit vectors that point outwards
    albedo: NDArray[np.float32]  # (T, 3) linear RGB
    material: NDArray[np.uint8]  # (T,) values of `Material`
    facade: NDArray[np.int32]  # (T,) row of `facades`; -1 for a triangle that is not part of a facade
    facades: NDArray[np.float32]  # (K, 16) descriptions of walls, made in `world.scenery`
    mesh_ranges: NDArray[np.int64]  # (M, 2) first triangle of each mesh, and one past its last
    mesh_objects: NDArray[np.int32]  # (M,) index of the annotated object that the mesh belongs to; -1 for none
    mesh_spheres: NDArray[np.float32]  # (M, 4) bounding spheres: centre x, y, z and radius, metres

    def __len__(self) -> int:
        return len(self.corners)

    @classmethod
    def from_mesh(
        cls, mesh: Mesh, facade: NDArray[np.int32] | None = None, facades: NDArray[np.float32] = NO_FACADES
    ) -> Self:
        """One mesh, in its own frame or with its faces in world coordinates already. facade: default: none."""
        corners = mesh.faces
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        points = corners.reshape(-1, 3)
        low, high = points.min(0), points.max(0)
        sphere = np.array([[*((low + high) / 2), np.linalg.norm(high - low) / 2 + 1e-3]], np.float32)
        facade = np.full(len(corners), -1, np.int32) if facade is None else facade
        whole, no_object = np.array([[0, len(corners)]]), np.full(1, -1, np.int32)
        return cls(corners, normals, mesh.albedo, mesh.material, facade, facades, whole, no_object, sphere)

    @classmethod
    def gather(cls, parts: Sequence[Self], objects: Sequence[int] | None = None) -> Self:
        """All meshes of all parts, in their order.

        objects: (M,) index of each mesh's object, -1 for none; default: those of the parts. Meshes of one object must
        follow each other.
        """
        rows = np.cumsum([0, *(len(part.facades) for part in parts)], dtype=np.int32)
        starts = np.cumsum([0, *(len(part) for part in parts)])
        shifted = [
            replace(
                part, facade=np.where(part.facade >= 0, part.facade + row, -1), mesh_ranges=part.mesh_ranges + start
            )
            for part, row, start in zip(parts, rows, starts, strict=False)
        ]
        soup = cls(*(np.concatenate([getattr(part, field.name) for part in shifted]) for field in fields(cls)))
        return soup if objects is None else replace(soup, mesh_objects=np.asarray(objects, np.int32))

    def painted(self, paint: NDArray[np.float32], dye: NDArray[np.float32], shaded: bool = False) -> Self:
        """The meshes with these linear colours (3,) on their PAINT and DYE faces.

        shaded: whether the albedo of these faces is a factor on the colour.
        """
        albedo = self.albedo.copy()
        for material, color in ((Material.PAINT, paint), (Material.DYE, dye)):
            of = self.material == material
            albedo[of] = np.minimum(albedo[of] * color, 1) if shaded else color
        return replace(self, albedo=albedo)

    def placed(self, position: tuple[float, float, float], yaw: float) -> Self:
        """A soup of one mesh, turned by `yaw` (radians) and moved to a world position (metres)."""
        cosine, sine = float(np.cos(yaw)), float(np.sin(yaw))
        corners = (_turned(self.corners, cosine, sine) + position).astype(np.float32)
        normals = _turned(self.normals, cosine, sine).astype(np.float32)
        x, y, z = position
        cx, cy, cz, radius = self.mesh_spheres[0]
        sphere = np.array([[cosine * cx - sine * cy + x, sine * cx + cosine * cy + y, cz + z, radius]], np.float32)
        return replace(self, corners=corners, normals=normals, mesh_spheres=sphere)


def _turned(vectors: NDArray[np.float32], cosine: float, sine: float) -> NDArray[np.float64]:
    """Vectors (..., 3) turned about z."""
    x, y, z = np.moveaxis(vectors.astype(np.float64), -1, 0)
    return np.stack([cosine * x - sine * y, sine * x + cosine * y, z], -1)


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


def twin_blocks(center: Point, size_lwh: Point, surface: Surface) -> Mesh:
    """Two cuboids on both sides of the plane y = 0. center: the middle of one of them."""
    x, y, z = center
    return joined(block((x, side * y, z), size_lwh, surface) for side in (-1, 1))


def wheel(x: float, y: float, radius: float, width: float, hub: Color = (122, 124, 128)) -> Mesh:
    """A tyre with a hub, standing on z = 0; its axle is parallel to y."""
    tyre = rod((x, y - width / 2, radius), (x, y + width / 2, radius), radius, (22, 22, 24), sections=12)
    rim = rod((x, y - width / 2 - 0.012, radius), (x, y + width / 2 + 0.012, radius), radius * 0.52, hub, sections=8)
    return joined([tyre, rim])


def axles(positions: Iterable[float], y: float, radius: float, width: float, *hub: Color) -> Mesh:
    """Two wheels at each position along x (metres), at -y and y."""
    return joined(wheel(x, side * y, radius, width, *hub) for x in positions for side in (-1, 1))


def made(rows: Iterable[Row]) -> list[Mesh]:
    """The parts that rows of a table describe."""
    return [make(*arguments) for make, *arguments in rows]
