"""Photographs in a rendered drive: the sky behind it, textures on its surfaces, and what makes them look real.

Shadows where objects touch the ground, and reflections of the sky in glass.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.transforms import Array
from bevcli.workshop.synth.looks import Looks, Weather
from bevcli.workshop.synth.material import MaterialFolder, Textures
from bevcli.workshop.synth.mesh import Material, TriangleSoup, linear
from bevcli.workshop.synth.photo_kernels import retouch_pixels
from bevcli.workshop.synth.shading_kernels import LIGHT_LIMIT

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
