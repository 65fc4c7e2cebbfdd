"""Meshes of files: of the ego vehicle, and those of classes, which stand in the scene scaled to each box.

trimesh, which takes half a second to load, reads them in a process of its own with limits of memory and time.
"""

import io
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.geometry.object_classes import Color, ObjectClass
from bevcli.geometry.transforms import Array
from bevcli.parsing.files import MIB, open_regular, read_bytes, run_python
from bevcli.printing import reason_of
from bevcli.recording.entities import EGO_COLOR, class_colors
from bevcli.recording.meshes import Mesh, VehicleMesh

FORMATS = (".glb", ".gltf", ".ply", ".obj", ".stl", ".off")  # no archives, whose contents may have any size
MEMORY, SECONDS = 1024 * MIB, 20.0  # limits of the process
READ = """
import sys, trimesh
from bevcli.workshop.meshes import write_parts
limit_memory()
sys.exit(write_parts(*sys.argv[1:]))
"""
LONGEST_M = 50.0  # a longer mesh is not in metres
MOST_TRIANGLES = 100_000  # of a mesh, which is drawn once for each box
FARTHEST = 1e9  # of a vertex from the origin, in the file's units
Part = tuple[Array, Array, NDArray[np.int64], NDArray[np.uint8]]  # the fields of a Mesh
SMOOTH_BELOW_RAD = np.radians(40.0)  # faces that meet at a smaller angle are shaded as one curved surface
LARGEST_BYTES = 64 * MIB  # of the file, and of each that it names
LARGEST_TEXT_BYTES = 16 * MIB  # of a format of text, of which trimesh makes sixty times as much
TEXT_FORMATS = (".obj", ".off")
GLTF_FILES = (".glb", ".gltf")
EGO_FROM_GLTF = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # glTF: y up, z forward, x left


def load_vehicle(path: Path) -> VehicleMesh:
    """The vehicle from a mesh file: .glb, .gltf, .ply, .obj, .stl or .off, read by trimesh.

    The file must be in metres, with its origin on the ground under the middle of the rear axle. Files in glTF format
    (.glb, .gltf) have glTF's axes: x left, y up, z forward. All other files have the ego frame's axes: x forward,
    y left, z up. Parts without a colour get the default car's blue.

    Materials, textures and buffers that the file names are read only in its own folder.

    Raises InputError where trimesh cannot read the file within 1 GiB and 20 s, and where it has no triangles or is
    longer than 50 m.
    """
    mesh = read_mesh(path)
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    if not np.isfinite(mesh.vertices).all() or not (high - low).max() <= LONGEST_M:
        size = " x ".join(f"{length:.4g}" for length in high - low)
        raise InputError(
            f"{path}: the vehicle's size is {size} m (expected at most {LONGEST_M:g} m; scale it to metres)"
        )
    (x0, y0), (x1, y1) = low[:2], high[:2]
    middle, half, length = (y0 + y1) / 2, (y1 - y0) / 2, x1 - x0
    outline = np.array([[x1, y0], [x1, y1], [x0, y1], [x0, y0], [x1, y0]])
    arrow = np.array([[-0.32 * length, -0.86 * half], [-0.08 * length, 0], [-0.32 * length, 0.86 * half]])
    return VehicleMesh(mesh, (outline, arrow + (x1, middle)))  # from above: a rectangle, and an arrow at its front


def read_class_meshes(classes: Mapping[str, ObjectClass]) -> dict[str, Mesh]:
    """The meshes of the classes that have one, by class, scaled to a cube of 1 m around the origin.

    Parts of a mesh without a colour have that of the class. A file that did not change is read once in a process.
    Raises InputError for a file that `read_mesh` does not take, and for one of more than MOST_TRIANGLES triangles.
    """
    colors = class_colors(classes.values())
    return {name: _read(name, Path(settings.mesh), colors[name]) for name, settings in classes.items() if settings.mesh}


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


def read_mesh(path: Path, color: Color = EGO_COLOR) -> Mesh:
    """All triangles of a mesh file, with the axes of the ego frame. color: of the parts that have none.

    Raises InputError where trimesh cannot read the file within 1 GiB and 20 s, and where it has no triangles.
    """
    if path.suffix.lower() not in FORMATS:
        raise InputError(f"{path}: is not a mesh file (expected a name that ends in {', '.join(FORMATS)})")
    try:
        done = run_python(READ, [path, *color], MEMORY, SECONDS)
    except subprocess.TimeoutExpired:
        raise InputError(f"{path}: takes more than {SECONDS:.0f} s to read (expected fewer triangles)") from None
    if done.returncode == 0:
        file = io.BytesIO(done.stdout)
        return Mesh(*(np.load(file, allow_pickle=False) for _ in range(4)))
    lines = done.stderr.decode(errors="replace").strip().splitlines()
    if done.returncode == 1 and lines:
        raise InputError(lines[-1])
    raise InputError(f"{path}: ends trimesh, which reads it (expected a mesh of fewer triangles)")


def write_parts(path: str, *color: str) -> str | None:
    """Write the arrays of a mesh file to stdout, for `read_mesh`. Returns what `sys.exit` takes."""
    try:
        corners, normals, faces, colors = zip(*read_parts(Path(path), tuple(map(int, color))), strict=True)
        starts = np.cumsum([0, *map(len, corners[:-1])])
        shifted = np.concatenate([indices + start for indices, start in zip(faces, starts, strict=True)])
        for array in (np.concatenate(corners), np.concatenate(normals), shifted, np.concatenate(colors)):
            np.save(sys.stdout.buffer, array)
    except InputError as error:
        return str(error)
    except MemoryError:
        return f"{path}: takes more than 1 GiB of memory (expected a mesh of fewer triangles)"
    return None


def read_parts(path: Path, color: tuple[int, ...]) -> list[Part]:
    """The triangle meshes of a file. color: of parts that have none. Raises InputError, MemoryError."""
    import trimesh

    suffix = path.suffix.lower()
    content = read_bytes(path, LARGEST_TEXT_BYTES if suffix in TEXT_FORMATS else LARGEST_BYTES)
    try:
        scene = trimesh.load_scene(io.BytesIO(content), file_type=suffix[1:], resolver=_Siblings(path.parent))
        if suffix in GLTF_FILES:
            scene.apply_transform(EGO_FROM_GLTF)
        parts = [_part(mesh, color) for mesh in scene.dump() if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces)]
    except MemoryError:
        raise
    except Exception as error:  # each of trimesh's many readers raises errors of its own
        reason = reason_of(error)
        raise InputError(
            f"{path}: trimesh cannot read this mesh file ({reason}); try .glb, .ply, .obj or .stl"
        ) from error
    if not parts:
        raise InputError(f"{path}: the file has no triangles (expected a triangle mesh)")
    return parts


class _Siblings(Mapping[str, bytes]):
    """The regular files of a folder by name, as trimesh asks for them: nothing outside of it, and no pipes."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder.resolve()

    def __getitem__(self, name: str) -> bytes:
        path = (self.folder / name).resolve()
        if not path.is_relative_to(self.folder):
            raise InputError(f"{name}: is outside of the mesh file's folder")
        return read_bytes(path, LARGEST_BYTES)

    def __iter__(self) -> Iterator[str]:
        return (path.name for path in self.folder.iterdir())

    def __len__(self) -> int:
        return sum(1 for _ in self)


def _part(mesh: Any, color: tuple[int, ...]) -> Part:
    """Vertices, normals, faces and colours of a trimesh.Trimesh, with sharp edges."""
    import trimesh

    visual = mesh.visual
    if visual.kind == "face":
        mesh.unmerge_vertices()  # no vertex may be shared by faces of different colours
        visual = mesh.visual
    if visual.kind == "texture":
        visual = visual.to_color()  # of each vertex; one colour for all of them where there is no texture image
    colors = visual.vertex_colors if visual.defined else (*color, 255)
    mesh.visual = trimesh.visual.ColorVisuals(vertex_colors=np.broadcast_to(colors, (len(mesh.vertices), 4)))
    mesh = trimesh.graph.smooth_shade(mesh, angle=SMOOTH_BELOW_RAD, facet_minarea=None)
    colors = np.array(mesh.visual.vertex_colors, dtype=np.uint8)[:, :3]
    return np.array(mesh.vertices), np.array(mesh.vertex_normals), np.array(mesh.faces), colors
