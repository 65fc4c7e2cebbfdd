"""The folder of a user with models of objects, photographs of the sky, and photographic textures.

    models/CLASS-NAME.npz    faces (F, 3, 3), albedo (F, 3), material (F,) of `Mesh`; share: see `Variant`
    skies/NAME.png           panorama, rows from the zenith to the horizon, columns clockwise seen from above
    textures/KIND-NAME.png   of one of TEXTURE_KINDS: 85 stands for the mean of the surface

Each kind of file may be missing; other files are ignored.
"""

import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.parsing.files import decode_image, read_bytes
from bevcli.workshop.synth.catalog import COLORS, Variant
from bevcli.workshop.synth.mesh import Material, Mesh

TEXTURE_KINDS = ("wall", "facade", "asphalt", "pavement", "leaf")
TEXTURE_MEAN = 85  # the value that leaves the brightness as it is
TEXTURE_SIZE = 256
FILES = ("models/*-*.npz", "skies/*.png", "textures/*-*.png")
MOST_PIXELS, MOST_BYTES = 2**25, 2**28
ALLOWED = (Material.MATTE, Material.PAINT, Material.GLASS, Material.GLOW, Material.DYE)


@dataclass(frozen=True, eq=False)
class Textures:
    """Photographic textures in sizes from TEXTURE_SIZE to 2, which repeat in both directions."""

    texels: NDArray[np.uint8]  # (N, K, 3) RGB, the sizes behind each other; TEXTURE_MEAN is a factor of 1
    offsets: NDArray[np.int64]  # (8,) first texel of each size
    aspects: NDArray[np.float64]  # (N,) width / height in the world
    of_kind: Mapping[str, list[int]]  # indices, by TEXTURE_KINDS

    def pick(self, kind: str, rng: np.random.Generator) -> tuple[int, float]:
        """Index and aspect of a texture of a kind; -1 and 1 where there is none."""
        indices = self.of_kind[kind]
        index = indices[int(rng.integers(len(indices)))] if indices else -1
        return index, float(self.aspects[index]) if indices else 1.0


@dataclass(frozen=True, eq=False)
class MaterialFolder:
    """What lies in a folder."""

    models: Mapping[str, tuple[Variant, ...]]  # by class
    skies: tuple[NDArray[np.uint8], ...]  # (H, W, 3) RGB
    textures: Textures

    @staticmethod
    @lru_cache(maxsize=1)
    def read(folder: str) -> "MaterialFolder":
        """The material in a folder; it is read once in a process. Raises InputError."""
        files = material_files(folder)
        models: dict[str, tuple[Variant, ...]] = {}
        for path in (path for path in files if path.suffix == ".npz"):
            model = _read_model(path)
            models[model.class_name] = (*models.get(model.class_name, ()), model)
        skies = tuple(_read_image(path) for path in files if path.parent.name == "skies")
        return MaterialFolder(models, skies, _read_textures([path for path in files if path.parent.name == "textures"]))


def material_files(folder: str) -> list[Path]:
    """The files of a folder that are used, in a fixed order. Raises InputError where there are none."""
    files = [path for pattern in FILES for path in sorted(Path(folder).glob(pattern))]
    if not files:
        found = "holds none of them" if Path(folder).is_dir() else "there is no such folder"
        raise InputError(f"{folder}: {found} (expected {', '.join(FILES)}): correct `material` in [training.rigs]")
    return files


def _read_model(path: Path) -> Variant:
    class_name, name = path.stem.split("-", 1)
    if class_name not in COLORS:
        raise InputError(f"{path}: expected CLASS-NAME.npz with a class of {', '.join(COLORS)}; found {class_name!r}")
    try:
        with np.load(path, allow_pickle=False) as data:
            faces, albedo, kinds, share = (data[key] for key in ("faces", "albedo", "material", "share"))
    except KeyError as error:
        raise InputError(f"{path}: {error.args[0]} (expected faces, albedo, material, share)") from None
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: cannot be read: {error}") from None
    count = len(faces) if faces.ndim else 0
    for key, array, shape in (
        ("faces", faces, (count, 3, 3)), ("albedo", albedo, (count, 3)), ("material", kinds, (count,)),
        ("share", share, ()),
    ):  # fmt: skip
        if array.shape != shape or not count or array.dtype.kind not in "uif" or not np.isfinite(array).all():
            found = f"{array.shape} of {array.dtype}"
            raise InputError(f"{path}: {key}: expected finite numbers of shape {shape}, found {found}")
    mesh = Mesh(faces.astype(np.float32), albedo.astype(np.float32), kinds.astype(np.uint8))
    if not np.isin(kinds, ALLOWED).all() or mesh.extents.min() < 0.01 or share <= 0:
        allowed = ", ".join(f"{int(kind)} {kind.name}" for kind in ALLOWED)
        raise InputError(f"{path}: expected materials {allowed}, sizes of 1 cm or more, a share above 0")
    return Variant(class_name, name, (mesh,), mesh.extents, *COLORS[class_name], float(share), shaded=True)


def _read_image(path: Path) -> NDArray[np.uint8]:
    """(H, W, 3) RGB, 2 pixels or more on each side."""
    pixels = decode_image(read_bytes(path, MOST_BYTES), cv2.IMREAD_COLOR_RGB, MOST_PIXELS)
    if pixels is None or min(pixels.shape[:2]) < 2:
        raise InputError(f"{path}: expected a whole image from 2 x 2 to {MOST_PIXELS} pixels")
    return np.asarray(pixels, np.uint8)


def _read_textures(paths: list[Path]) -> Textures:
    of_kind: dict[str, list[int]] = {kind: [] for kind in TEXTURE_KINDS}
    sizes = [TEXTURE_SIZE >> level for level in range(8)]
    texels, aspects = np.zeros((len(paths), sum(size * size for size in sizes), 3), np.uint8), np.ones(len(paths))
    for index, path in enumerate(paths):
        kind = path.stem.split("-", 1)[0]
        if kind not in of_kind:
            expected = ", ".join(TEXTURE_KINDS)
            raise InputError(f"{path}: expected KIND-NAME.png with a kind of {expected}; found {kind!r}")
        of_kind[kind].append(index)
        image = _read_image(path)
        aspects[index] = image.shape[1] / image.shape[0]
        levels = [cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA) for size in sizes]
        texels[index] = np.concatenate([level.reshape(-1, 3) for level in levels])
    return Textures(texels, np.cumsum([0, *(size * size for size in sizes[:-1])]), aspects, of_kind)
