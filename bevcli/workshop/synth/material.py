"""Photographs and models of a user in rendered drives: the folder that holds them, and how a drive uses them.

    models/CLASS-NAME.npz    faces (F, 3, 3), albedo (F, 3), material (F,) of `Mesh`; share: see `Variant`
    skies/NAME.png           panorama, rows from the zenith to the horizon, columns clockwise seen from above
    textures/KIND-NAME.png   of one of TEXTURE_KINDS: 85 stands for the mean of the surface

Each kind of file may be missing; other files are ignored. A drive with photographs has the sky of one behind it,
textures on its surfaces, shadows where objects touch the ground, and reflections of the sky in glass.
"""

import zipfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.geometry.transforms import Array
from bevcli.parsing.files import read_bytes
from bevcli.parsing.images import decode_image
from bevcli.workshop.synth.catalog import COLORS, Variant
from bevcli.workshop.synth.mesh import Material, Mesh, TriangleSoup, linear
from bevcli.workshop.synth.rig import material_files
from bevcli.workshop.synth.scenery import Looks, Weather
from bevcli.workshop.synth.shading_kernels import LIGHT_LIMIT, TEXTURE_SIZE, retouch_pixels

TEXTURE_KINDS = ("wall", "facade", "asphalt", "pavement", "leaf")
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


NO_SKY = np.zeros((0, 0, 3), np.uint8)
SKY_SHARE, NEAR_SHARE, TEXTURED_SHARE, CONTACT_SHARE, GLOSS_SHARE = 0.7, 0.5, 0.85, 0.85, 0.8  # of the drives
CONTACT_M, CONTACT_CELL_M = 144, 0.1  # side of the square with shadows under objects, size of its cells
FACADE_GREY = 0.5  # albedo under the photograph of a facade
Placed = tuple[Array, float, Array]  # middle (2 or more,), yaw and size of an object, metres


@dataclass(frozen=True, eq=False)
class Coats:
    """The textures of the meshes of the scenery."""

    of_triangle: NDArray[np.int32]  # (S,) mesh of each triangle
    # (M, 8) texture (-1: none), its width and height (metres), strength, shifts (widths); texture and width of leaves
    rows: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class PhotoLooks:
    """The photographs of one drive."""

    looks: Looks
    textures: Textures
    weather: Weather  # with the colours of the sky
    scenery_m: float  # the scenery ends here at the latest; a near end lets the sky's horizon be seen
    sky: NDArray[np.uint8]  # (H, W, 3) RGB; empty for none
    sky_light: NDArray[np.float64]  # (256, 3) light of its values
    turn: float  # of the sky about the vertical, radians
    mirrored: bool
    gloss: float  # strength of the reflections in glass
    pattern_share: float  # factor on the strength of `Looks.pattern`
    facades: float  # share of the facades that are photographs
    walls: float  # share of the other surfaces with a texture
    # (8,) texture (-1: none), width in metres and strength of asphalt; of pavement; texture and width of patches
    ground: NDArray[np.float32]
    contact: float  # strength of the shadows under objects

    @staticmethod
    def draw(looks: Looks, material: MaterialFolder, weather: Weather) -> "PhotoLooks":
        """The photographs of the drive with these looks."""
        rng, textures = looks.stream("photo"), material.textures
        has_sky = len(material.skies) > 0 and rng.random() < SKY_SHARE
        sky = material.skies[int(rng.integers(len(material.skies)))] if has_sky else NO_SKY
        near, reach, textured = rng.random() < NEAR_SHARE, float(rng.uniform(45, 75)), rng.random() < TEXTURED_SHARE
        sky_light = np.zeros((256, 3))
        if has_sky:
            sky_light, weather = _lit(sky, weather, rng)
        asphalt, pavement, patches = (textures.pick(k, rng)[0] for k in ("asphalt", "pavement", "asphalt"))
        ground = (
            *(asphalt, rng.uniform(1.8, 4.5), rng.uniform(0.4, 1.3)),
            *(pavement, rng.uniform(0.8, 3.0), rng.uniform(0.3, 1.0)),
            *(patches, rng.uniform(9, 25)),
        )
        none = (-1, 1, 0, -1, 1, 0, -1, 1)
        contact = float(rng.uniform(0.4, 0.7)) * (rng.random() < CONTACT_SHARE)
        gloss = float(rng.uniform(0.1, 0.75)) * (rng.random() < GLOSS_SHARE)
        return PhotoLooks(
            looks, textures, weather, reach if near and has_sky else np.inf, sky, sky_light,
            float(rng.uniform(0, 2 * np.pi)), bool(rng.random() < 0.5), gloss,
            float(rng.uniform(0.1, 0.5)) if textured and rng.random() < 0.6 else 1.0,
            float(rng.uniform(0, 0.8)) * textured, float(rng.uniform(0.3, 1.0)) * textured,
            np.array(ground if textured else none, np.float32), contact,
        )  # fmt: skip

    def coated(self, soup: TriangleSoup) -> tuple[TriangleSoup, Coats]:
        """The scenery with facades that are photographs, and its textures; the same for a mesh at the same place."""
        albedo, material = soup.albedo.copy(), soup.material.copy()
        rows = np.full((len(soup.mesh_ranges), 8), -1, np.float32)
        for row, (start, end), (x, y, *_) in zip(rows, soup.mesh_ranges, soup.mesh_spheres, strict=True):
            rng = self.looks.stream("coat", int(10 * x), int(10 * y))
            (index, aspect), width = self.textures.pick("wall", rng), rng.uniform(1.2, 5.2)
            row[:] = (
                *(index if rng.random() < self.walls else -1, width, width / aspect, rng.uniform(0.3, 1.0)),
                *(rng.random(), rng.random(), self.textures.pick("leaf", rng)[0] if self.walls else -1),
                rng.uniform(1, 2),
            )
            (facade, aspect), height = self.textures.pick("facade", rng), rng.uniform(7, 16)
            walls = np.flatnonzero(material[start:end] == Material.FACADE) + start
            if len(walls) and facade >= 0 and rng.random() < self.facades:
                row[:6] = facade, height * aspect, height, 1.0, row[4], 0.0
                material[walls] = Material.MATTE
                albedo[walls] = FACADE_GREY * rng.uniform(0.6, 1.4) * rng.uniform(0.9, 1.1, 3)
        counts = soup.mesh_ranges[:, 1] - soup.mesh_ranges[:, 0]
        coats = Coats(np.repeat(np.arange(len(counts), dtype=np.int32), counts), rows)
        return replace(soup, albedo=albedo, material=material), coats

    def view(self, coats: Coats, placed: Iterable[Placed], here: Array) -> "PhotoView":
        """What the images of one time need. placed: the objects on the ground. here: (2,) middle of the shadows."""
        x, y = np.floor(here) - CONTACT_M // 2
        darkness = np.zeros((int(CONTACT_M / CONTACT_CELL_M),) * 2, np.uint8)
        for middle, yaw, size in placed:
            is_vehicle = size[1] > 1.2
            half = size[:2] / 2 + 0.15 if is_vehicle else size[:2] * 0.4
            ahead = np.array([np.cos(yaw), np.sin(yaw)]) * half[0]
            aside = np.array([-np.sin(yaw), np.cos(yaw)]) * half[1]
            corners = middle[:2] - (x, y) + np.array([ahead + aside, aside - ahead, -ahead - aside, ahead - aside])
            pixels = np.round(corners / CONTACT_CELL_M * 16).astype(np.int32)  # of 1 / 16 of a cell
            cv2.fillConvexPoly(darkness, pixels, 255 if is_vehicle else 150, cv2.LINE_8, 4)
        darkness = np.asarray(cv2.blur(cv2.blur(darkness, (5, 5)), (5, 5)), np.uint8)
        return PhotoView(self, coats, (darkness, float(x), float(y), CONTACT_CELL_M, self.contact))


def _lit(sky: NDArray[np.uint8], weather: Weather, rng: np.random.Generator) -> tuple[Array, Weather]:
    """The light (256, 3) of a sky's values, about as bright as the weather's sky, and the weather with its colours."""
    small = linear(cv2.resize(sky, (128, 32), interpolation=cv2.INTER_AREA))
    seen, usual = np.median(small[11:].mean(-1)), weather.light[[3, 4, 4]].mean()  # cameras see the lower part
    gain = np.clip(usual * rng.uniform(0.6, 1.4) / max(seen, 1e-3), 0.25, 1.6) * rng.uniform(0.94, 1.06, 3)
    zenith, horizon = (small[part].mean((0, 1)) * gain for part in (slice(13), slice(27, None)))
    light, mix = weather.light.copy(), rng.uniform(0.3, 0.9)
    for row, color in ((3, zenith), (4, horizon), (5, 0.95 * horizon)):  # sky overhead, at the horizon, haze
        light[row] += (np.minimum(color, 1.2) - light[row]) * mix
    return linear(np.arange(256))[:, None] * gain, replace(weather, light=light)


@dataclass(frozen=True, eq=False)
class PhotoView:
    """The photographs of a drive at one time, for `render_view`."""

    photo: PhotoLooks
    coats: Coats  # of the scenery, whose triangles are the first of the soup
    contact: tuple[NDArray[np.uint8], float, float, float, float]  # as `retouch_pixels` takes it

    def retouch(
        self, buffer: tuple[NDArray, NDArray], soup: TriangleSoup, view: Any, table: NDArray[np.uint8],
        needed: NDArray[np.uint8], image: NDArray[np.uint8],
    ) -> None:  # fmt: skip
        """Draw the photographs over a shaded image, in place. The arguments are those of `shade_pixels`."""
        photo = self.photo
        shown = table[(np.minimum(photo.sky_light / LIGHT_LIMIT, 1) * (len(table) - 1)).astype(np.int64)]
        retouch_pixels(
            buffer, (soup.normals, soup.material), view, photo.weather.kind.haze_m,
            (photo.sky, shown, photo.turn, photo.mirrored, photo.gloss),
            (photo.textures.texels, photo.textures.offsets), (self.coats.of_triangle, self.coats.rows), photo.ground,
            self.contact, needed, image,
        )  # fmt: skip
