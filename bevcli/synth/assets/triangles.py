"""Meshes placed in the world, and all triangles of a scene in one set of arrays.

A `MeshTemplate` is a mesh that is placed many times. Placing it gives a `PlacedMesh`. A `TriangleSoup` holds many
placed meshes; each of them is a range of its triangles, which the rasteriser can skip as a whole.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bevcli.synth.assets.mesh import Mesh
from bevcli.synth.assets.paint import Material

NO_FACADES = np.zeros((0, 16), np.float32)


@dataclass(frozen=True)
class Triangles:
    """T triangles in the world frame.

    Attributes:
        corners: (T, 3, 3) corner points, metres; counter-clockwise seen from outside.
        normals: (T, 3) unit vectors that point outwards.
        albedo: (T, 3) linear RGB.
        material: (T,) values of `Material`.
        facade: (T,) row of `facades`; -1 for a triangle that is not part of a facade.
        facades: (K, 16) rows made by `world.buildings.facade_row`.
    """

    corners: NDArray[np.float32]
    normals: NDArray[np.float32]
    albedo: NDArray[np.float32]
    material: NDArray[np.uint8]
    facade: NDArray[np.int32]
    facades: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.corners)

    @staticmethod
    def joined(parts: Sequence[Triangles]) -> Triangles:
        """All triangles of all parts, in their order."""
        starts = np.cumsum([0, *(len(part.facades) for part in parts)])
        facade = [np.where(part.facade >= 0, part.facade + k, -1) for part, k in zip(parts, starts, strict=False)]
        corners, normals, albedo, material, facades = (
            np.concatenate([getattr(part, name) for part in parts])
            for name in ("corners", "normals", "albedo", "material", "facades")
        )
        return Triangles(corners, normals, albedo, material, np.concatenate(facade).astype(np.int32), facades)


@dataclass(frozen=True)
class PlacedMesh:
    """One mesh in the world.

    Attributes:
        triangles: the mesh's triangles.
        sphere: (4,) bounding sphere: centre x, y, z and radius, metres.
    """

    triangles: Triangles
    sphere: NDArray[np.float32]

    @staticmethod
    def from_mesh(
        mesh: Mesh, facade: NDArray[np.int32] | None = None, facades: NDArray[np.float32] | None = None
    ) -> PlacedMesh:
        """Place a mesh whose faces are in world coordinates already. facade, facades: as in `Triangles`."""
        corners = mesh.faces
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        points = corners.reshape(-1, 3)
        low, high = points.min(0), points.max(0)
        sphere = np.array([*((low + high) / 2), np.linalg.norm(high - low) / 2 + 1e-3], np.float32)
        if facade is None or facades is None:
            facade, facades = np.full(len(corners), -1, np.int32), NO_FACADES
        return PlacedMesh(Triangles(corners, normals, mesh.albedo, mesh.material, facade, facades), sphere)


@dataclass(frozen=True)
class MeshTemplate:
    """A mesh that is placed many times; its normals and its bounding sphere are computed once.

    Attributes:
        mesh: the mesh in its own frame.
        normals: (F, 3) unit vectors of its faces.
        sphere: (4,) bounding sphere: centre x, y, z and radius, metres.
    """

    mesh: Mesh
    normals: NDArray[np.float32]
    sphere: NDArray[np.float32]

    @staticmethod
    def of(mesh: Mesh) -> MeshTemplate:
        """The template of a mesh."""
        placed = PlacedMesh.from_mesh(mesh)
        return MeshTemplate(mesh, placed.triangles.normals, placed.sphere)

    def painted(self, paint: NDArray[np.float32], dye: NDArray[np.float32]) -> MeshTemplate:
        """The template with these linear colours (3,) on its PAINT and DYE faces."""
        albedo = self.mesh.albedo.copy()
        albedo[self.mesh.material == Material.PAINT] = paint
        albedo[self.mesh.material == Material.DYE] = dye
        return replace(self, mesh=replace(self.mesh, albedo=albedo))

    def placed(self, position: tuple[float, float, float], yaw: float) -> PlacedMesh:
        """The mesh turned by `yaw` (radians) and moved to a world position (metres)."""
        cosine, sine = float(np.cos(yaw)), float(np.sin(yaw))
        corners = (_turned(self.mesh.faces, cosine, sine) + position).astype(np.float32)
        normals = _turned(self.normals, cosine, sine).astype(np.float32)
        x, y, z = position
        cx, cy, cz, radius = self.sphere
        sphere = np.array([cosine * cx - sine * cy + x, sine * cx + cosine * cy + y, cz + z, radius], np.float32)
        no_facade = np.full(len(corners), -1, np.int32)
        mesh = self.mesh
        return PlacedMesh(Triangles(corners, normals, mesh.albedo, mesh.material, no_facade, NO_FACADES), sphere)


def _turned(vectors: NDArray[np.float32], cosine: float, sine: float) -> NDArray[np.float64]:
    """Vectors (..., 3) turned about z."""
    x, y, z = np.moveaxis(vectors.astype(np.float64), -1, 0)
    return np.stack([cosine * x - sine * y, sine * x + cosine * y, z], -1)


@dataclass(frozen=True)
class TriangleSoup:
    """M placed meshes in one set of arrays.

    Attributes:
        triangles: the triangles of all meshes.
        mesh_ranges: (M, 2) first triangle of each mesh, and one past its last.
        mesh_objects: (M,) index of the annotated object that the mesh belongs to; -1 for none.
        mesh_spheres: (M, 4) bounding spheres: centre x, y, z and radius, metres.
    """

    triangles: Triangles
    mesh_ranges: NDArray[np.int64]
    mesh_objects: NDArray[np.int32]
    mesh_spheres: NDArray[np.float32]

    @staticmethod
    def gather(meshes: Sequence[PlacedMesh], objects: Sequence[int]) -> TriangleSoup:
        """Put meshes into one set of arrays.

        objects: (M,) index of each mesh's object, -1 for none. Meshes of one object must follow each other.
        """
        counts = np.array([len(mesh.triangles) for mesh in meshes], np.int64)
        ends = np.cumsum(counts)
        return TriangleSoup(
            Triangles.joined([mesh.triangles for mesh in meshes]),
            np.stack([ends - counts, ends], -1),
            np.asarray(objects, np.int32),
            np.stack([mesh.sphere for mesh in meshes]),
        )

    def joined(self, other: TriangleSoup) -> TriangleSoup:
        """This soup followed by another one."""
        return TriangleSoup(
            Triangles.joined([self.triangles, other.triangles]),
            np.concatenate([self.mesh_ranges, other.mesh_ranges + len(self.triangles)]),
            np.concatenate([self.mesh_objects, other.mesh_objects]),
            np.concatenate([self.mesh_spheres, other.mesh_spheres]),
        )
