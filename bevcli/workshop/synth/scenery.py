"""The looks of a drive (light, sky, colours), and objects without annotations: houses, kerbs, trees, signals."""

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from bevcli.geometry.transforms import Array
from bevcli.workshop.synth.catalog import TREE_KINDS, StreetFurniture, any_color, nameless
from bevcli.workshop.synth.city import CORNER_M, DIRECTIONS, KERB_M, Block, CityPlan, right_of, side_of
from bevcli.workshop.synth.mesh import Color, Finish, Material, Mesh, TriangleSoup, from_faces, joined, linear
from bevcli.workshop.synth.traffic import Signals

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
    """The weather of a name, with sun and clouds drawn from `rng`."""
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


BRICK: tuple[Color, ...] = ((150, 82, 62), (128, 66, 54), (168, 108, 80), (110, 74, 64), (178, 130, 98))
PLASTER: tuple[Color, ...] = (
    (214, 202, 178), (198, 178, 142), (186, 192, 190), (222, 214, 204), (176, 150, 128), (164, 178, 162),
    (206, 172, 144),
)  # fmt: skip
OFFICE: tuple[Color, ...] = ((120, 126, 132), (150, 152, 150), (90, 98, 106), (176, 172, 164))
ROOF: Color = (104, 98, 94)


@dataclass(frozen=True)
class FacadeStyle:
    """The look of a wall."""

    wall: Color  # sRGB colour of the wall
    floor_m: float  # height of a storey, metres
    pitch_m: float  # distance between the middles of two windows, metres
    window_m: tuple[float, float]  # width and height of a window, metres
    shop_m: float  # height of the ground floor, metres; below 1 it is a plinth instead of a shop front
    brick: float  # contrast of the brick pattern, 0 to 1; 0 is plaster
    band: bool  # whether the windows of a storey form one horizontal band
    seed: int  # seed of the random details, 0 to 4095


def houses(city: CityPlan, land: Block) -> Iterator[TriangleSoup]:
    """Row houses along the four sides of a block, with some gaps: of each house its walls, and the rest of it."""
    rng = city.stream("houses", land.column, land.row)
    (x0, y0), (x1, y1) = land.inside()
    depth = min(14.0, (x1 - x0) / 2 - 2, (y1 - y0) / 2 - 2)
    for low, high in ((y0, y0 + depth), (y1 - depth, y1)):
        for a, b in _lots(rng, x0, x1):
            yield from _house(city, rng, (a, low), (b, high))
    for low, high in ((x0, x0 + depth), (x1 - depth, x1)):
        for a, b in _lots(rng, y0 + depth + 0.5, y1 - depth - 0.5):
            yield from _house(city, rng, (low, a), (high, b))


def _lots(rng: np.random.Generator, start: float, end: float) -> list[tuple[float, float]]:
    """Cut a side of a block into lots of 9 to 24 m, given by start and end. One lot in ten stays empty."""
    lots, at = [], start
    while at < end - 8:
        to = min(at + rng.uniform(9, 24), end)
        if end - to < 8:
            to = end
        if rng.random() > 0.1:
            lots.append((at, to))
        at = to
    return lots


def _style(rng: np.random.Generator, height: float) -> FacadeStyle:
    seed = int(rng.integers(4096))
    shop = 3.9 if rng.random() < 0.6 else 0.6
    kind = rng.random()
    if kind < 0.42:
        wall, brick, band = BRICK[rng.integers(len(BRICK))], 0.9, False
    elif kind < 0.78 or height < 12:
        wall, brick, band = PLASTER[rng.integers(len(PLASTER))], 0.0, False
    else:
        wall, brick, band = OFFICE[rng.integers(len(OFFICE))], 0.0, True
    pitch = rng.uniform(2.2, 3.4)
    window = (min(rng.uniform(1.0, 1.7), pitch - 0.5), rng.uniform(1.4, 1.9))
    return FacadeStyle(wall, rng.uniform(3.0, 3.5), pitch, window, shop, brick, band, seed)


def _house(
    city: CityPlan, rng: np.random.Generator, low: tuple[float, float], high: tuple[float, float]
) -> list[TriangleSoup]:
    """The walls and the rest of a house on a plan rectangle, with its four corners mapped to the world."""
    storeys = int(rng.choice([2, 3, 4, 5, 6, 8, 11], p=[0.12, 0.22, 0.22, 0.18, 0.12, 0.09, 0.05]))
    style = _style(rng, storeys * 3.2)
    height = style.shop_m + storeys * style.floor_m + 0.9 + KERB_M
    setback = rng.choice([0.0, 0.0, 0.6])
    corners = np.array([low, (high[0], low[1]), high, (low[0], high[1])], dtype=np.float64)
    corners += setback * np.sign(corners.mean(0) - corners)
    ground = city.bend(corners)
    walls, rows = zip(*(_wall(ground[k], ground[(k + 1) % 4], height, style) for k in range(4)), strict=True)
    middle = ground.mean(0)  # the roof is a flat slab that overhangs the walls by 0.25 m
    wide = middle + (ground - middle) * (1 + 0.25 / np.linalg.norm(ground - middle, axis=1, keepdims=True))
    slab = [np.column_stack([wide, np.full(4, z)]) for z in (height - 0.22, height + 0.12)]
    red, green, blue = (int(component * 0.8) for component in style.wall)
    rest = [_prism(slab, (red, green, blue) if style.band else ROOF)]
    if style.shop_m > 1:
        rest += _awnings(rng, ground)
    for _ in range(int(rng.integers(0, 3))):
        at = middle + rng.uniform(-3, 3, 2)
        square = at + np.array([(1.1, 0.8), (-1.1, 0.8), (-1.1, -0.8), (1.1, -0.8)])
        rest.append(_prism([np.column_stack([square, np.full(4, height + z)]) for z in (0.0, 1.3)], (150, 150, 148)))
    facade = np.repeat(np.arange(4), 2).astype(np.int32)
    return [TriangleSoup.from_mesh(joined(walls), facade, np.stack(rows)), TriangleSoup.from_mesh(joined(rest))]


def _wall(start: Array, end: Array, height: float, style: FacadeStyle) -> tuple[Mesh, NDArray[np.float32]]:
    """Two triangles between two world points (2,), and the (16,) numbers that describe them to the shading kernel."""
    length = float(np.hypot(*(end - start)))
    tangent = (end - start) / length  # counter-clockwise around the house
    a, b, top_a, top_b = (*start, 0.0), (*end, 0.0), (*start, height), (*end, height)
    mesh = from_faces([[a, b, top_b], [a, top_b, top_a]], Finish(style.wall, Material.FACADE))
    row = [
        *start, *tangent, height, length, style.floor_m, style.pitch_m, *style.window_m, style.shop_m, style.brick,
        float(style.band) + 2.0 * style.seed, *linear(style.wall),
    ]  # fmt: skip
    return mesh, np.array(row, np.float32)


def _awnings(rng: np.random.Generator, ground: Array) -> Iterator[Mesh]:
    colors: tuple[Color, ...] = ((164, 44, 40), (42, 92, 66), (44, 66, 120), (206, 196, 176), (198, 138, 44))
    for k in range(4):
        start, end = ground[k], ground[(k + 1) % 4]
        length = np.hypot(*(end - start))
        if rng.random() > 0.4 or length < 9:
            continue
        way = (end - start) / length
        out = np.array([way[1], -way[0]])
        a = start + way * rng.uniform(1.0, length - 5.5)
        b = a + way * 4.0
        footprint = np.array([a, a + out * 1.3, b + out * 1.3, b])
        rings = [np.column_stack([footprint, (h, e, e, h)]) for h, e in ((3.15, 2.65), (3.3, 2.72))]
        yield _prism(rings, colors[int(rng.integers(len(colors)))])


def _prism(rings: ArrayLike, color: Color) -> Mesh:
    """A faster `mesh.loft` between two convex rings (2, P, 3), counter-clockwise from above, the lower one first."""
    points = np.asarray(rings, dtype=np.float32)
    count = points.shape[1]
    following = [(i, (i + 1) % count) for i in range(count)]
    faces = [(i, j, j + count) for i, j in following] + [(i, j + count, i + count) for i, j in following]
    for i in range(1, count - 1):
        faces += [(0, i + 1, i), (count, count + i, count + i + 1)]
    return from_faces(points.reshape(-1, 3)[faces], color)


def kerb_slab(city: CityPlan, outline: Array) -> Mesh:
    """The raised ground of a block over a plan outline (P, 2): kerb stones around a top with the material GROUND."""
    ring = city.bend(outline)
    middle = ring.mean(0)
    following = np.roll(ring, -1, axis=0)
    a, b, top_a, top_b = (
        np.column_stack([points, np.full(len(ring), z)]) for z in (0.0, KERB_M) for points in (ring, following)
    )
    center = np.tile([*middle, KERB_M], (len(ring), 1))
    sides = np.concatenate([np.stack([a, b, top_b], 1), np.stack([a, top_b, top_a], 1)])
    faces = np.concatenate([sides, np.stack([top_a, top_b, center], 1)]).astype(np.float32)
    material = np.r_[np.full(len(sides), Material.MATTE), np.full(len(ring), Material.GROUND)].astype(np.uint8)
    return Mesh(faces, np.tile(linear((176, 174, 168)), (len(faces), 1)), material)


SIGNALS_REACH_M = 110.0  # traffic signals are drawn within this distance


class Scenery:
    """The scenery of a city. Blocks are made when they are first needed, and kept."""

    def __init__(self, city: CityPlan, furniture: StreetFurniture, looks: Looks | None = None) -> None:
        self.city, self.furniture, self._looks = city, furniture, looks
        self._block = lru_cache(maxsize=None)(self._make_block)

    def around(self, center: ArrayLike, reach_m: float) -> TriangleSoup:
        """Meshes within `reach_m` metres of a world point (2,)."""
        meshes = [mesh for block in self.city.around(center, reach_m).blocks for mesh in self._block(*block)]
        spheres = np.concatenate([mesh.mesh_spheres for mesh in meshes])
        distances = np.hypot(*(spheres[:, :2] - np.asarray(center, dtype=np.float64)).T)
        # Draw walls first, near ones before far ones: they hide most of the rest, which is then skipped.
        order = np.lexsort([distances, [len(mesh.facades) == 0 for mesh in meshes]])
        return TriangleSoup.gather([meshes[k] for k in order if distances[k] < reach_m + spheres[k, 3]])

    def _make_block(self, column: int, row: int) -> list[TriangleSoup]:
        land, use = self.city.block(column, row), self.city.landuse(column, row)
        meshes = [TriangleSoup.from_mesh(kerb_slab(self.city, land.kerb))]
        if use == "houses":
            meshes += houses(self.city, land)
        rng = self.city.stream("furniture", column, row)
        if use == "park":
            low, high = land.inside(1.5)
            for point in low + rng.random((int(np.prod(high - low) / 75), 2)) * (high - low):
                kinds = self.furniture.trees if rng.random() < 0.7 else self.furniture.bushes
                meshes.append(self._put(kinds[int(rng.integers(len(kinds)))], point, rng.uniform(0, 6.3)))
        for side in range(4):
            meshes += self._side(land, side, rng)
        return meshes

    def _side(self, land: Block, side: int, rng: np.random.Generator) -> Iterator[TriangleSoup]:
        """The pavement on one side of a block: trees, lamps and signs near the kerb, benches and bins between them."""
        start, way, inward, length = side_of(land.low, land.high, side)
        street = self.city.street(side % 2, (land.row, land.column + 1, land.row + 1, land.column)[side])
        outward = self.city.heading(start, -inward)
        at, lamp_next = CORNER_M + 3.0, bool(rng.random() < 0.5)
        while at < length - CORNER_M - 3:
            point = start + way * at + inward * 0.75
            if lamp_next:
                yield self._put(self.furniture.lamp, point, outward)
            elif street.trees and rng.random() < 0.8:
                kind = (street.index * 5 + side * 3 + int(rng.integers(3))) % TREE_KINDS
                yield self._put(self.furniture.trees[kind], point, rng.uniform(0, 6.3))
            elif rng.random() < 0.5:
                sign = self.furniture.signs[int(rng.integers(6))]
                yield self._put(sign, point, self.city.heading(point, -way))
            if rng.random() < 0.3:
                extra = self.furniture.small[int(rng.integers(3))]
                yield self._put(extra, point + way * rng.uniform(1.5, 3), outward + np.pi)
            lamp_next = not lamp_next if rng.random() < 0.6 else False
            at += rng.uniform(6.5, 9.5)
        if rng.random() < 0.25:
            spot = start + way * length * rng.uniform(0.3, 0.7) + inward * 1.9
            yield self._put(self.furniture.shelter, spot, outward)
        if self._looks is not None:
            for mesh, along, away in self._looks.clutter(length, land.column, land.row, side):
                yield self._put(mesh, start + way * along + inward * away, outward + along)

    def _put(self, template: TriangleSoup, point: Array, yaw: float) -> TriangleSoup:
        x, y = self.city.bend(point)
        return template.placed((float(x), float(y), KERB_M), yaw)

    def signals_around(self, here: ArrayLike, signals: Signals, time_s: float) -> Iterator[TriangleSoup]:
        """Traffic signals around a world point (2,): for each approach, behind the junction on the right."""
        city = self.city
        for node, direction in product(city.around(here, SIGNALS_REACH_M).nodes, range(4)):
            street, cross = city.street_at(node, direction), city.street_at(node, direction + 1)
            ahead = DIRECTIONS[direction] * (cross.half_width + 0.9)
            spot = city.node_center(node) + ahead + right_of(direction) * (street.half_width + 0.9)
            template = self.furniture.signals[signals.light(node, direction % 2, time_s)]
            yield self._put(template, spot, city.heading(spot, -DIRECTIONS[direction]))
