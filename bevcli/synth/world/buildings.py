"""Houses along the edges of a block, and the kerb around it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.transforms import Array
from bevcli.synth.assets.mesh import Material, Mesh, prism
from bevcli.synth.assets.paint import Color, darker, linear
from bevcli.synth.world.city import KERB_M, Block, CityPlan

BRICK: tuple[Color, ...] = ((150, 82, 62), (128, 66, 54), (168, 108, 80), (110, 74, 64), (178, 130, 98))
PLASTER: tuple[Color, ...] = (
    (214, 202, 178),
    (198, 178, 142),
    (186, 192, 190),
    (222, 214, 204),
    (176, 150, 128),
    (164, 178, 162),
    (206, 172, 144),
)
OFFICE: tuple[Color, ...] = ((120, 126, 132), (150, 152, 150), (90, 98, 106), (176, 172, 164))
ROOF: Color = (104, 98, 94)


@dataclass(frozen=True)
class FacadeStyle:
    """The look of a wall.

    Attributes:
        wall: sRGB colour of the wall.
        floor_m: height of a storey, metres.
        pitch_m: distance between the middles of two windows, metres.
        window_m: width and height of a window, metres.
        shop_m: height of the ground floor, metres; below 1 it is a plinth instead of a shop front.
        brick: contrast of the brick pattern, 0 to 1; 0 is plaster.
        band: whether the windows of a storey form one horizontal band.
        seed: seed of the random details, 0 to 4095.
    """

    wall: Color
    floor_m: float
    pitch_m: float
    window_m: tuple[float, float]
    shop_m: float
    brick: float
    band: bool
    seed: int


def facade_row(
    style: FacadeStyle, origin: NDArray[np.float64], tangent: NDArray[np.float64], height: float, length: float
) -> NDArray[np.float32]:
    """(16,) numbers that describe a wall to the shading kernel.

    origin: (2,) world point of the wall's start, metres. tangent: (2,) unit vector along the wall, counter-clockwise
    around the house. height, length: of the wall, metres.
    """
    wall = linear(style.wall)
    return np.array(
        [*origin, *tangent, height, length, style.floor_m, style.pitch_m, *style.window_m, style.shop_m, style.brick,
         float(style.band) + 2.0 * (style.seed % 4096), *wall], np.float32,
    )  # fmt: skip


@dataclass(frozen=True)
class Wall:
    """One wall of a house, in the world frame.

    Attributes:
        mesh: two triangles with the material FACADE.
        row: (16,) made by `facade_row`.
    """

    mesh: Mesh
    row: NDArray[np.float32]


@dataclass(frozen=True)
class House:
    """One building, in the world frame.

    Attributes:
        walls: its four walls.
        rest: roof, awnings and roof structures.
    """

    walls: tuple[Wall, ...]
    rest: tuple[Mesh, ...]


def houses(city: CityPlan, land: Block) -> list[House]:
    """Row houses along the four sides of a block, with some gaps."""
    rng = city.stream("houses", land.column, land.row)
    south, east, north, west = land.sidewalks
    x0, y0 = land.low[0] + west, land.low[1] + south
    x1, y1 = land.high[0] - east, land.high[1] - north
    depth = min(14.0, (x1 - x0) / 2 - 2, (y1 - y0) / 2 - 2)
    built: list[House] = []
    for a, b in _lots(rng, x0, x1):
        built.append(_house(city, rng, (a, y0), (b, y0 + depth)))
    for a, b in _lots(rng, x0, x1):
        built.append(_house(city, rng, (a, y1 - depth), (b, y1)))
    for a, b in _lots(rng, y0 + depth + 0.5, y1 - depth - 0.5):
        built.append(_house(city, rng, (x0, a), (x0 + depth, b)))
    for a, b in _lots(rng, y0 + depth + 0.5, y1 - depth - 0.5):
        built.append(_house(city, rng, (x1 - depth, a), (x1, b)))
    return built


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


def _house(city: CityPlan, rng: np.random.Generator, low: tuple[float, float], high: tuple[float, float]) -> House:
    """A house on a plan rectangle, with its four corners mapped to the world."""
    storeys = int(rng.choice([2, 3, 4, 5, 6, 8, 11], p=[0.12, 0.22, 0.22, 0.18, 0.12, 0.09, 0.05]))
    style = _style(rng, storeys * 3.2)
    height = style.shop_m + storeys * style.floor_m + 0.9 + KERB_M
    setback = rng.choice([0.0, 0.0, 0.6])
    corners = np.array([low, (high[0], low[1]), high, (low[0], high[1])], dtype=np.float64)
    corners += setback * np.sign(corners.mean(0) - corners)
    ground = city.bend(corners)
    walls = tuple(_wall(ground[k], ground[(k + 1) % 4], height, style) for k in range(4))
    rest = [_roof(ground, height, style)]
    if style.shop_m > 1:
        rest += _awnings(rng, ground)
    middle = ground.mean(0)
    for _ in range(int(rng.integers(0, 3))):
        at = middle + rng.uniform(-3, 3, 2)
        square = at + np.array([(1.1, 0.8), (-1.1, 0.8), (-1.1, -0.8), (1.1, -0.8)])
        rest.append(prism([np.column_stack([square, np.full(4, height + z)]) for z in (0.0, 1.3)], (150, 150, 148)))
    return House(walls, tuple(rest))


def _wall(start: Array, end: Array, height: float, style: FacadeStyle) -> Wall:
    length = float(np.hypot(*(end - start)))
    a, b = (*start, 0.0), (*end, 0.0)
    top_a, top_b = (*start, height), (*end, height)
    faces = np.array([[a, b, top_b], [a, top_b, top_a]], np.float32)
    mesh = Mesh(faces, np.tile(linear(style.wall), (2, 1)), np.full(2, Material.FACADE, np.uint8))
    return Wall(mesh, facade_row(style, start, (end - start) / length, height, length))


def _roof(ground: Array, height: float, style: FacadeStyle) -> Mesh:
    """A flat slab that overhangs the walls by 0.25 m."""
    middle = ground.mean(0)
    wide = middle + (ground - middle) * (1 + 0.25 / np.linalg.norm(ground - middle, axis=1, keepdims=True))
    rings = [np.column_stack([wide, np.full(4, z)]) for z in (height - 0.22, height + 0.12)]
    return prism(rings, darker(style.wall, 0.8) if style.band else ROOF)


def _awnings(rng: np.random.Generator, ground: Array) -> list[Mesh]:
    """Slanted awnings over some of the shop fronts."""
    colors: tuple[Color, ...] = ((164, 44, 40), (42, 92, 66), (44, 66, 120), (206, 196, 176), (198, 138, 44))
    parts = []
    for k in range(4):
        start, end = ground[k], ground[(k + 1) % 4]
        if rng.random() > 0.4 or np.hypot(*(end - start)) < 9:
            continue
        way = (end - start) / np.hypot(*(end - start))
        out = np.array([way[1], -way[0]])
        at = start + way * rng.uniform(1.0, np.hypot(*(end - start)) - 5.5)
        a, b = at, at + way * 4.0
        footprint = np.array([a, a + out * 1.3, b + out * 1.3, b])
        rings = [np.column_stack([footprint, (h, e, e, h)]) for h, e in ((3.15, 2.65), (3.3, 2.72))]
        parts.append(prism(rings, colors[int(rng.integers(len(colors)))]))
    return parts


def kerb_slab(city: CityPlan, outline: Array) -> Mesh:
    """The raised ground of a block over a plan outline (P, 2): kerb stones around a top with the material GROUND."""
    ring = city.bend(outline)
    middle = ring.mean(0)
    following = np.roll(ring, -1, axis=0)
    low, high = np.zeros((len(ring), 1)), np.full((len(ring), 1), KERB_M)
    a, b = np.hstack([ring, low]), np.hstack([following, low])
    top_a, top_b = np.hstack([ring, high]), np.hstack([following, high])
    center = np.tile([*middle, KERB_M], (len(ring), 1))
    sides = np.concatenate([np.stack([a, b, top_b], 1), np.stack([a, top_b, top_a], 1)])
    faces = np.concatenate([sides, np.stack([top_a, top_b, center], 1)]).astype(np.float32)
    material = np.r_[np.full(len(sides), Material.MATTE), np.full(len(ring), Material.GROUND)].astype(np.uint8)
    return Mesh(faces, np.tile(linear((176, 174, 168)), (len(faces), 1)), material)
