"""Meshes placed in the world, all in one set of arrays.

A `TriangleSoup` holds any number of meshes; each of them is a range of its triangles, which the rasteriser can skip as
a whole. A soup of one mesh in its own frame is a template: its normals and its sphere are computed once, and it is
placed many times.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from bevcli.synth.assets.mesh import Mesh
from bevcli.synth.assets.paint import Material

NO_FACADES = np.zeros((0, 16), np.float32)


@dataclass(frozen=True)
class TriangleSoup:
    """T triangles of M meshes in the world frame.

    Attributes:
        corners: (T, 3, 3) corner points, metres; counter-clockwise seen from outside.
        normals: (T, 3) unit vectors that point outwards.
        albedo: (T, 3) linear RGB.
        material: (T,) values of `Material`.
        facade: (T,) row of `facades`; -1 for a triangle that is not part of a facade.
        facades: (K, 16) descriptions of walls, made in `world.scenery`.
        mesh_ranges: (M, 2) first triangle of each mesh, and one past its last.
        mesh_objects: (M,) index of the annotated object that the mesh belongs to; -1 for none.
        mesh_spheres: (M, 4) bounding spheres: centre x, y, z and radius, metres.
    """

    corners: NDArray[np.float32]
    normals: NDArray[np.float32]
    albedo: NDArray[np.float32]
    material: NDArray[np.uint8]
    facade: NDArray[np.int32]
    facades: NDArray[np.float32]
    mesh_ranges: NDArray[np.int64]
    mesh_objects: NDArray[np.int32]
    mesh_spheres: NDArray[np.float32]

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

    def painted(self, paint: NDArray[np.float32], dye: NDArray[np.float32]) -> Self:
        """The meshes with these linear colours (3,) on their PAINT and DYE faces."""
        albedo = self.albedo.copy()
        albedo[self.material == Material.PAINT] = paint
        albedo[self.material == Material.DYE] = dye
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
