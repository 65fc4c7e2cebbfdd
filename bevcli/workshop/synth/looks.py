"""The looks of a drive: the light of its weather, and for training varied shapes, colours, patterns and light.

Varied looks are not to look real: what all of them share is what also holds for photographs. Positions, sizes and
classes of the annotated objects stay.
"""

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.workshop.synth.mesh import Color, Material, Mesh, TriangleSoup, ball, block, cone, joined, linear, rod

Range = tuple[float, float]  # lowest and highest value


@dataclass(frozen=True)
class Weather:
    """The light of a drive. A light of 1 is about the brightness of a white surface in full sun.

    The rows of `light` are the light from the sun, from above and, reflected by the ground, from below; the colours of
    the sky overhead and at the horizon, of the haze and of the clouds.
    """

    name: str  # one of WEATHER_NAMES
    to_sun: NDArray[np.float64]  # (3,) unit vector, world
    light: NDArray[np.float64]  # (7, 3) linear RGB
    clouds: NDArray[np.float32]  # (512, 512) cover, 0 to 1, of a horizontal plane; it repeats in both directions
    kind: "WeatherKind"


class WeatherKind(NamedTuple):
    """The numbers of one kind of weather. A range is drawn uniformly; a number is taken as it is."""

    elevation: Range | float  # of the sun, radians
    sun: tuple[float, float, float]  # colour of the sunlight, linear RGB
    strength: float  # of the sunlight
    sky: tuple[float, float, float]  # light from above, linear RGB
    zenith: Color
    horizon: Color
    cloud: Color
    cloud_threshold: Range | float  # noise above it is cloud, 0 to 1
    haze_m: float  # distance after which about 63 % of the light comes from the haze, metres
    lamps: float  # brightness of lamps and lit windows, relative
    shadow_softness_m: float  # width of the edge of shadows, metres


_KINDS = {
    "noon": WeatherKind(
        (0.65, 1.05), (1.0, 0.95, 0.86), 1.25, (0.32, 0.39, 0.50),
        (84, 136, 206), (190, 212, 232), (255, 255, 255), (0.45, 0.62), 420.0, 0.5, 0.05,
    ),
    "evening": WeatherKind(
        (0.22, 0.38), (1.0, 0.70, 0.42), 0.95, (0.26, 0.28, 0.38),
        (92, 118, 178), (250, 206, 160), (255, 214, 178), (0.42, 0.6), 300.0, 1.2, 0.12,
    ),
    "overcast": WeatherKind(
        1.35, (0.95, 0.98, 1.0), 0.22, (0.50, 0.53, 0.57),
        (150, 158, 168), (205, 210, 214), (222, 226, 230), 0.2, 230.0, 0.8, 0.8,
    ),
}  # fmt: skip
WEATHER_NAMES = tuple(_KINDS)


def make_weather(name: str, rng: np.random.Generator) -> Weather:
    """The weather of a name, with sun and clouds drawn from `rng`. Raises InputError where the name is not known."""
    if name not in _KINDS:
        raise InputError(f"weather: expected {', '.join(WEATHER_NAMES[:-1])} or {WEATHER_NAMES[-1]}, found {name!r}")
    kind = _KINDS[name]
    azimuth, elevation = rng.uniform(0, 2 * np.pi), _drawn(kind.elevation, rng)
    sun = (np.array(kind.sun) * kind.strength).astype(np.float32)
    sky, horizon = np.array(kind.sky, np.float32), linear(kind.horizon)
    bounce = (0.22 * (sun * np.sin(elevation) + sky) + 0.25 * sky).astype(np.float32)
    haze = horizon * np.float32(0.95)
    return Weather(
        name,
        np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]),
        np.array([sun, sky, bounce, linear(kind.zenith), horizon, haze, linear(kind.cloud)], np.float64),
        _clouds(rng, _drawn(kind.cloud_threshold, rng)),
        kind,
    )


def _drawn(value: Range | float, rng: np.random.Generator) -> float:
    return rng.uniform(*value) if isinstance(value, tuple) else value


def _clouds(rng: np.random.Generator, threshold: float) -> NDArray[np.float32]:
    """(512, 512) cloud cover, 0 to 1, repeating in both directions: five octaves of noise above a threshold."""
    size = 512
    total = np.zeros((size, size))
    for octave in range(5):
        total += tiling_noise(rng, size, 4 * 2**octave) * 0.5**octave
    total = (total - total.min()) / (total.max() - total.min())
    cover = np.clip((total - threshold) / 0.25, 0, 1)
    return (cover * cover * (3 - 2 * cover)).astype(np.float32)


def tiling_noise(rng: np.random.Generator, size: int, cells: int, low: float = 0.0) -> NDArray[np.float64]:
    """(size, size) smooth noise from about low to low + 1 with `cells` waves a side; it repeats in both directions."""
    coarse = np.pad(rng.random((cells, cells)), 2, mode="wrap") + low
    scale = size // cells
    fine = cv2.resize(coarse, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    return np.asarray(fine[2 * scale : 2 * scale + size, 2 * scale : 2 * scale + size])


RECOLOURED_SHARE = 0.4  # of the colours of a mesh
CLUTTER_PER_M = 0.12  # nameless objects for each metre of pavement
BENT = 0.07  # largest shift of a point by `bent`, in sizes of the mesh


@dataclass(frozen=True)
class Looks:
    """The varied looks of one drive. seed: the drive's."""

    seed: int

    def stream(self, *names: int | str) -> np.random.Generator:
        """Random numbers for one purpose, the same for each drive of the seed."""
        numbers = [zlib.crc32(str(name).encode()) for name in names]
        return np.random.default_rng([self.seed, 0x6C6F6F6B, *numbers])

    def body(self, mesh: Mesh, name: str, recolour: bool = True) -> Mesh:
        """The mesh of an individual with a shape of its own and, with recolour, colours. name: of the individual."""
        rng = self.stream("body", name)
        mesh = bent(mesh, rng)
        return recoloured(mesh, rng) if recolour else mesh

    def paint(self, paint: NDArray[np.float32], name: str) -> NDArray[np.float32]:
        """(3,) linear RGB: any colour for a half of the individuals, else the given one."""
        rng = self.stream("paint", name)
        return any_color(rng) if rng.random() < 0.5 else paint

    def scenery(self, soup: TriangleSoup) -> TriangleSoup:
        """The soup with other colours; the same for a mesh at the same place."""
        albedo, facades = soup.albedo.copy(), soup.facades.copy()
        for (start, end), (x, y, *_) in zip(soup.mesh_ranges, soup.mesh_spheres, strict=True):
            rng = self.stream("scenery", int(10 * x), int(10 * y))
            if rng.random() < RECOLOURED_SHARE:
                changed = ~np.isin(soup.material[start:end], (Material.GLASS, Material.GLOW))
                albedo[start:end][changed] = any_color(rng)
        for facade in facades:
            rng = self.stream("facade", int(facade[12]))
            if rng.random() < RECOLOURED_SHARE:
                facade[13:16] = any_color(rng)
        return replace(soup, albedo=albedo, facades=facades)

    def ground(self, texels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """(K, 3) texels of the ground in other colours and with another contrast."""
        rng = self.stream("ground")
        tint, contrast = rng.uniform(0.85, 1.15, 3) * rng.uniform(0.6, 1.3), rng.uniform(0.6, 1.2)
        levels = np.arange(256)[:, None]
        table = np.clip((90 + (levels - 90) * contrast) * tint, 0, 255).astype(np.uint8)
        return np.stack([table[texels[:, c], c] for c in range(3)], -1)

    def weather(self, weather: Weather) -> Weather:
        """Other colours of sun and sky, and another height of the sun."""
        rng = self.stream("weather")
        light = weather.light * rng.uniform(0.85, 1.15, (7, 3)) * rng.uniform(0.6, 1.3, (7, 1))
        elevation, azimuth = rng.uniform(0.2, 1.4), rng.uniform(0, 2 * np.pi)
        flat = np.cos(elevation)
        to_sun = np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])
        kind = weather.kind._replace(haze_m=float(np.exp(rng.uniform(np.log(80), np.log(900)))))
        return replace(weather, light=light, to_sun=to_sun, kind=kind)

    def pattern(self) -> tuple[float, float, float]:
        """Strength, waves per metre and hardness (0 to 1) of the pattern on all surfaces but the ground."""
        rng = self.stream("pattern")
        return (
            float(rng.uniform(0, 0.9)),
            float(np.exp(rng.uniform(np.log(1.5), np.log(40)))),
            float(rng.random() < 0.4),
        )

    def clutter(self, length_m: float, *indices: int) -> Iterator[tuple[TriangleSoup, float, float]]:
        """Nameless objects on a pavement, with their distances along it and away from the kerb, metres."""
        rng = self.stream("clutter", *indices)
        for _ in range(rng.poisson(length_m * CLUTTER_PER_M)):
            yield TriangleSoup.from_mesh(nameless(rng)), rng.uniform(4, max(length_m - 4, 5)), rng.uniform(0.8, 4.5)


def any_color(rng: np.random.Generator) -> NDArray[np.float32]:
    """(3,) linear RGB of any brightness; greys are frequent."""
    grey = rng.random() ** 2
    color = grey + (rng.random(3) - grey) * rng.random()
    return np.asarray(0.02 + 0.9 * color, np.float32)


def recoloured(mesh: Mesh, rng: np.random.Generator) -> Mesh:
    """The mesh with some of its colours exchanged; glass and lamps stay."""
    albedo = mesh.albedo.copy()
    colors, of_face = np.unique(mesh.albedo, axis=0, return_inverse=True)
    fixed = np.isin(mesh.material, (Material.GLASS, Material.GLOW))
    for index in range(len(colors)):
        if rng.random() < RECOLOURED_SHARE:
            albedo[(of_face.reshape(-1) == index) & ~fixed] = any_color(rng)
    return replace(mesh, albedo=albedo)


def bent(mesh: Mesh, rng: np.random.Generator) -> Mesh:
    """The mesh bent smoothly inside its cuboid, the same on its left and right."""
    points = mesh.faces.reshape(-1, 3).astype(np.float64)
    low, size = points.min(0), np.maximum(np.ptp(points, axis=0), 1e-6)
    x, y, z = ((points - low) / size).T  # 0 to 1
    (a, b, c), (power, taper, wave) = rng.uniform(-BENT, BENT, 3), rng.uniform(-1, 1, 3)
    bump = 4 * x * (1 - x)
    moved = np.stack([
        x + bump * (a + b * z) + wave * 0.03 * np.sin(2 * np.pi * x),
        0.5 + (y - 0.5) * (1 - 0.12 * abs(taper) * (z if taper > 0 else 1 - z)),
        np.clip(z, 0, 1) ** np.exp(0.15 * power) * (1 + c * bump * z),
    ], -1)  # fmt: skip
    faces = (low + moved * size).reshape(-1, 3, 3).astype(np.float32)
    return replace(mesh, faces=faces)


def nameless(rng: np.random.Generator) -> Mesh:
    """One to four blocks, balls, cones and poles on top of each other or side by side, 0.3 to 5 m."""
    parts = []
    for _ in range(int(rng.integers(1, 5))):
        length, width, height = np.exp(rng.uniform(np.log(0.2), np.log((3.0, 1.2, 3.0))))
        x, y, low = *rng.uniform(-0.5, 0.5, 2), float(rng.uniform(0, 1)) * (rng.random() < 0.4)
        red, green, blue = (int(255 * c) for c in any_color(rng) ** 0.45)
        color: Color = (red, green, blue)
        kind = rng.integers(4)
        if kind == 0:
            parts.append(block((x, y, low + height / 2), (length, width, height), color))
        elif kind == 1:
            parts.append(ball((x, y, low + height / 2), (length / 2, width / 2, height / 2), color))
        elif kind == 2:
            parts.append(cone(low, low + height, width / 2, width / 2 * float(rng.random()) + 0.01, color))
        else:
            parts.append(rod((x, y, 0), (x + rng.uniform(-1, 1), y, height + 1), 0.03 + 0.1 * rng.random(), color))
    return joined(parts)
