"""The triangles of a mesh file, read by trimesh, which takes half a second to load: in a process of its own.

See `bevcli.workshop.meshes` for who starts it.
"""

import io
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.geometry.transforms import Array
from bevcli.parsing.files import MIB, read_bytes
from bevcli.printing import reason_of

Part = tuple[Array, Array, NDArray[np.int64], NDArray[np.uint8]]  # the fields of a Mesh
SMOOTH_BELOW_RAD = np.radians(40.0)  # faces that meet at a smaller angle are shaded as one curved surface
LARGEST_BYTES = 64 * MIB  # of the file, and of each that it names
LARGEST_TEXT_BYTES = 16 * MIB  # of a format of text, of which trimesh makes sixty times as much
TEXT_FORMATS = (".obj", ".off")
GLTF_FILES = (".glb", ".gltf")
EGO_FROM_GLTF = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # glTF: y up, z forward, x left


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
