"""Meshes of classes: each box of such a class has its mesh in the scene, scaled to the box."""

import os
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path

import numpy as np
import rerun as rr

from bevcli.errors import InputError
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.object_classes import ObjectClass
from bevcli.parsing.files import open_regular
from bevcli.recording import entities
from bevcli.recording.colors import Color, class_colors
from bevcli.recording.components import components
from bevcli.recording.log_boxes import quaternions
from bevcli.recording.mesh_file import Mesh, read_mesh

MOST_TRIANGLES = 100_000  # of a mesh, which is drawn once for each box
FARTHEST = 1e9  # of a vertex from the origin, in the file's units


def read_class_meshes(classes: Mapping[str, ObjectClass]) -> dict[str, Mesh]:
    """The meshes of the classes that have one, by class, scaled to a cube of 1 m around the origin.

    Parts of a mesh without a colour have that of the class. A file that did not change is read once in a process.
    Raises InputError for a file that `read_mesh` does not take, and for one of more than MOST_TRIANGLES triangles.
    """
    colors = class_colors(classes.values())
    return {name: _read(name, Path(one.mesh), colors[name]) for name, one in classes.items() if one.mesh}


def _read(name: str, path: Path, color: Color) -> Mesh:
    try:
        with open_regular(path) as file:
            changed_ns = os.fstat(file.fileno()).st_mtime_ns
        return _unit_cube(path, color, changed_ns)
    except InputError as error:
        raise InputError(f'mesh of class "{name}": {error}') from None


@lru_cache(maxsize=16)
def _unit_cube(path: Path, color: Color, changed_ns: int) -> Mesh:
    """changed_ns: time of the file's last change; a file that has changed is read again."""
    mesh = read_mesh(path, color)
    if len(mesh.faces) > MOST_TRIANGLES:
        raise InputError(f"{path}: the mesh has {len(mesh.faces):,} triangles (expected at most {MOST_TRIANGLES:,})")
    if not np.abs(mesh.vertices).max() < FARTHEST:
        raise InputError(f"{path}: a number of the mesh is not finite, or too large (expected less than {FARTHEST:g})")
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    extents = np.where(high > low, high - low, 1)  # a flat mesh stays flat
    normals = mesh.normals * extents
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(float).tiny)
    return mesh._replace(vertices=(mesh.vertices - (low + high) / 2) / extents, normals=normals)


def log_class_meshes(stream: rr.RecordingStream, boxes: Boxes3D, classes: Mapping[str, ObjectClass]) -> None:
    """Writes where the meshes of classes stand: one in each box of the class. boxes: in the recording's world."""
    for name in (name for name, one in classes.items() if one.mesh):
        own = boxes[boxes.classes == name]
        # The last one has no size: an entity without poses would show its mesh at the origin.
        poses = components(
            rr.InstancePoses3D,
            translations=np.append(own.centers, [[0, 0, 0]], axis=0),
            quaternions=np.append(quaternions(own), [[0, 0, 0, 1]], axis=0),
            scales=np.append(own.sizes_lwh, [[0, 0, 0]], axis=0),
        )
        stream.log(entities.class_mesh(name), poses)
