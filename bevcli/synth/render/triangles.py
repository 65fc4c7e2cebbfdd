"""Meshes placed in the world, gathered to one soup of triangles in runs that the rasteriser can skip as a whole."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from bevcli.synth.assets.mesh import Material, Mesh
from bevcli.synth.render.shading import Surfaces

NO_FACADES = np.zeros((0, 16), np.float32)


@dataclass(frozen=True)
class Run:
    """Triangles of one thing. sphere: (4,) x, y, z, radius. facade: (T,) row of facades, -1 for none."""

    corners: NDArray[np.float32]
    normals: NDArray[np.float32]
    albedo: NDArray[np.float32]
    material: NDArray[np.uint8]
    facade: NDArray[np.int32]
    facades: NDArray[np.float32]
    sphere: NDArray[np.float32]


@dataclass(frozen=True)
class Soup:
    """Many runs as one. runs: (R, 2) first and last-plus-one triangle. objects: (R,). spheres: (R, 4)."""

    surfaces: Surfaces
    runs: NDArray[np.int64]
    objects: NDArray[np.int32]
    spheres: NDArray[np.float32]


@dataclass(frozen=True)
class Shape:
    """A mesh ready to be placed many times: its normals and bounding sphere are known."""

    mesh: Mesh
    normals: NDArray[np.float32]
    sphere: NDArray[np.float32]

    @staticmethod
    def of(mesh: Mesh) -> Shape:
        """Work out what placing needs."""
        run = make_run(mesh.faces, mesh.albedo, mesh.material)
        return Shape(mesh, run.normals, run.sphere)

    def painted(self, paint: NDArray[np.float32], dye: NDArray[np.float32]) -> Shape:
        """The shape with its PAINT and DYE faces in these linear colours (3,)."""
        albedo = self.mesh.albedo.copy()
        albedo[self.mesh.material == Material.PAINT] = paint
        albedo[self.mesh.material == Material.DYE] = dye
        return replace(self, mesh=replace(self.mesh, albedo=albedo))


def place(shape: Shape, position: tuple[float, float, float], yaw: float) -> Run:
    """A shape at a world position, turned by yaw."""
    x, y, z = position
    corners, normals = np.empty_like(shape.mesh.faces), np.empty_like(shape.normals)
    cosine, sine = float(np.cos(yaw)), float(np.sin(yaw))
    _turn_and_shift(shape.mesh.faces, shape.normals, cosine, sine, float(x), float(y), float(z), corners, normals)
    cx, cy, cz, radius = shape.sphere
    sphere = np.array([cosine * cx - sine * cy + x, sine * cx + cosine * cy + y, cz + z, radius], np.float32)
    none = np.full(len(corners), -1, np.int32)
    return Run(corners, normals, shape.mesh.albedo, shape.mesh.material, none, NO_FACADES, sphere)


@njit(cache=True, nogil=True)
def _turn_and_shift(
    faces: NDArray, normals: NDArray, cosine: float, sine: float, x: float, y: float, z: float,
    out_corners: NDArray, out_normals: NDArray,
) -> None:  # fmt: skip
    for t in range(faces.shape[0]):
        for i in range(3):
            a, b = faces[t, i, 0], faces[t, i, 1]
            out_corners[t, i, 0] = cosine * a - sine * b + x
            out_corners[t, i, 1] = sine * a + cosine * b + y
            out_corners[t, i, 2] = faces[t, i, 2] + z
        a, b = normals[t, 0], normals[t, 1]
        out_normals[t, 0] = cosine * a - sine * b
        out_normals[t, 1] = sine * a + cosine * b
        out_normals[t, 2] = normals[t, 2]


def make_run(
    corners: NDArray[np.float32],
    albedo: NDArray[np.float32],
    material: NDArray[np.uint8],
    facade: NDArray[np.int32] | None = None,
    facades: NDArray[np.float32] | None = None,
) -> Run:
    """A run of world triangles (T, 3, 3), with their normals and bounding sphere."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    points = corners.reshape(-1, 3)
    low, high = points.min(0), points.max(0)
    sphere = np.array([*((low + high) / 2), np.linalg.norm(high - low) / 2 + 1e-3], np.float32)
    if facade is None or facades is None:
        facade, facades = np.full(len(corners), -1, np.int32), NO_FACADES
    return Run(corners, normals, albedo, material, facade, facades, sphere)


def gather(runs: Sequence[Run], objects: Sequence[int]) -> Soup:
    """All runs as one soup; objects: (R,) the object of each run, -1 for none, runs of an object side by side."""
    counts = np.array([len(run.corners) for run in runs], np.int64)
    ends = np.cumsum(counts)
    shifted, facade_count = [], 0
    for run in runs:
        shifted.append(run.facade + np.int32(facade_count) if len(run.facades) else run.facade)
        facade_count += len(run.facades)
    facades = np.concatenate([run.facades for run in runs])
    surfaces = Surfaces(
        np.concatenate([run.corners for run in runs]),
        np.concatenate([run.normals for run in runs]),
        np.concatenate([run.albedo for run in runs]),
        np.concatenate([run.material for run in runs]),
        np.concatenate(shifted),
        facades if len(facades) else np.zeros((1, 16), np.float32),
    )
    spheres = np.stack([run.sphere for run in runs])
    return Soup(surfaces, np.stack([ends - counts, ends], -1), np.asarray(objects, np.int32), spheres)


def joined_soup(first: Soup, second: Soup) -> Soup:
    """Two soups as one, the first one's triangles first."""
    a, b = first.surfaces, second.surfaces
    offset = len(a.corners)
    facade = np.where(b.facade >= 0, b.facade + len(a.facades), -1).astype(np.int32)
    surfaces = Surfaces(
        np.concatenate([a.corners, b.corners]),
        np.concatenate([a.normals, b.normals]),
        np.concatenate([a.albedo, b.albedo]),
        np.concatenate([a.material, b.material]),
        np.concatenate([a.facade, facade]),
        np.concatenate([a.facades, b.facades]),
    )
    return Soup(
        surfaces,
        np.concatenate([first.runs, second.runs + offset]),
        np.concatenate([first.objects, second.objects]),
        np.concatenate([first.spheres, second.spheres]),
    )
