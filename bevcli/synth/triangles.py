"""Meshes placed in the world, gathered to one soup of triangles in runs that the rasteriser can skip as a whole."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bevcli.synth.mesh import Material, Mesh
from bevcli.synth.shading import Surfaces


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


def place(
    mesh: Mesh,
    position: tuple[float, float, float],
    yaw: float,
    paint: NDArray[np.float32] | None = None,
    dye: NDArray[np.float32] | None = None,
) -> Run:
    """A mesh at a world position, turned by yaw, its PAINT and DYE faces in the given linear colours (3,)."""
    c, s = np.float32(np.cos(yaw)), np.float32(np.sin(yaw))
    x, y = mesh.faces[..., 0], mesh.faces[..., 1]
    corners = np.empty_like(mesh.faces)
    corners[..., 0] = c * x - s * y + np.float32(position[0])
    corners[..., 1] = s * x + c * y + np.float32(position[1])
    corners[..., 2] = mesh.faces[..., 2] + np.float32(position[2])
    albedo = mesh.albedo
    if paint is not None or dye is not None:
        albedo = albedo.copy()
        if paint is not None:
            albedo[mesh.material == Material.PAINT] = paint
        if dye is not None:
            albedo[mesh.material == Material.DYE] = dye
    return make_run(corners, albedo, mesh.material)


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
        facade, facades = np.full(len(corners), -1, np.int32), np.zeros((0, 16), np.float32)
    return Run(corners, normals, albedo, material, facade, facades, sphere)


def gather(runs: Sequence[Run], objects: Sequence[int]) -> Soup:
    """All runs as one soup; objects: (R,) the object of each run, -1 for none, runs of an object side by side."""
    counts = np.array([len(run.corners) for run in runs], np.int64)
    ends = np.cumsum(counts)
    shifted, facade_count = [], 0
    for run in runs:
        shifted.append(np.where(run.facade >= 0, run.facade + facade_count, -1).astype(np.int32))
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
