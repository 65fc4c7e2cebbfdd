"""Meshes of road works (machines, cones, barriers), and of what is not annotated: trees, lamps, signs, benches.

A barrier's long side is its width, as in nuScenes annotations.
"""

from itertools import product

import numpy as np

from bevcli.workshop.synth.mesh import (
    CARGO,
    GLASS,
    PAINT,
    TRIM,
    Color,
    Finish,
    Material,
    Mesh,
    Row,
    TriangleSoup,
    axles,
    ball,
    block,
    cone,
    crossbar,
    joined,
    made,
    rod,
    side_profile,
    twin_blocks,
)

WORN_STEEL = (96, 96, 98)
BLACK_RUBBER = (30, 30, 32)


def _cabin(x: float, y: float, bottom: float, size: tuple[float, float, float]) -> Mesh:
    length, width, height = size
    posts = [(x + sx * length, y + sy * width) for sx in (-0.5, 0.5) for sy in (-0.5, 0.5)]
    parts = [
        block((x, y, bottom + height * 0.15), (length, width, height * 0.3), PAINT),
        block((x, y, bottom + height * 0.62), (length * 0.94, width * 0.94, height * 0.66), GLASS),
        block((x, y, bottom + height), (length * 1.06, width * 1.06, 0.1), PAINT),
    ]
    return joined([*parts, *(rod((*at, bottom), (*at, bottom + height), 0.05, TRIM, sections=4) for at in posts)])


def _track(y: float, length: float, height: float, width: float) -> Mesh:
    half, foot, shoulder = length / 2, length / 2 - height / 2, length / 2 - height * 0.35
    outline = [
        (-foot, 0), (foot, 0), (half, height * 0.5), (shoulder, height), (-shoulder, height), (-half, height * 0.5),
    ]  # fmt: skip
    start, end, z = y - width / 2 - 0.02, y + width / 2 + 0.02, height * 0.45
    positions = (-half * 0.7, -half * 0.25, half * 0.25, half * 0.7)
    rollers = [rod((x, start, z), (x, end, z), height * 0.3, WORN_STEEL, sections=8) for x in positions]
    return joined([side_profile(outline, width / 2, BLACK_RUBBER, y=y), *rollers])


MIXER_DRUM = [(-3.6, 1.6), (-2.0, 1.25), (0.6, 1.35), (1.2, 1.9), (0.9, 2.9), (-1.0, 3.2), (-3.4, 2.6)]
MACHINES: dict[str, tuple[Row, ...]] = {
    "excavator": (
        (_track, 1.05, 3.6, 0.85, 0.5),
        (_track, -1.05, 3.6, 0.85, 0.5),
        (block, (0, 0, 0.75), (2.0, 1.6, 0.4), TRIM),
        (block, (-0.9, 0, 1.5), (2.2, 2.5, 1.1), PAINT),
        (block, (-1.9, 0, 1.5), (0.5, 2.4, 1.0), TRIM),
        (_cabin, 0.6, 0.7, 1.0, (1.4, 1.0, 1.9)),
        (rod, (0.6, -0.3, 1.5), (2.6, -0.3, 3.3), 0.2, PAINT, 6),
        (rod, (2.6, -0.3, 3.3), (3.9, -0.3, 1.6), 0.16, PAINT, 6),
        (rod, (0.9, -0.3, 2.3), (2.1, -0.3, 3.1), 0.08, (200, 200, 202)),
        (side_profile, [(3.6, 1.6), (4.2, 1.5), (3.9, 0.6), (3.2, 0.5), (3.2, 0.9)], 0.5, WORN_STEEL, -0.3),
    ),
    "loader": (
        (block, (-1.7, 0, 1.5), (2.0, 1.9, 1.1), PAINT),
        (block, (0.6, 0, 1.1), (2.4, 1.2, 0.6), PAINT),
        (block, (-2.7, 0, 1.3), (0.2, 2.0, 0.8), TRIM),
        (_cabin, -0.3, 0, 1.5, (1.3, 1.4, 1.7)),
        (axles, (-1.7, 1.4), 1.0, 0.75, 0.55, (220, 190, 60)),
        *[(rod, (0.6, y, 1.6), (2.7, y, 0.7), 0.11, PAINT) for y in (-0.6, 0.6)],
        (side_profile, [(2.6, 0.15), (3.6, 0.1), (3.5, 0.3), (2.9, 1.1), (2.6, 1.1)], 1.35, WORN_STEEL),
    ),
    "backhoe": (
        (block, (0.9, 0, 1.2), (2.0, 1.0, 0.7), PAINT),
        (_cabin, -0.6, 0, 0.9, (1.5, 1.6, 1.9)),
        (axles, (-1.1,), 0.9, 0.72, 0.5, (220, 190, 60)),
        (axles, (1.4,), 0.85, 0.48, 0.35, (220, 190, 60)),
        *[(rod, (0.9, y, 1.3), (2.5, y, 0.6), 0.09, PAINT) for y in (-0.6, 0.6)],
        (side_profile, [(2.4, 0.1), (3.2, 0.1), (3.1, 0.3), (2.6, 0.9), (2.4, 0.9)], 1.15, WORN_STEEL),
        (rod, (-1.6, 0, 1.0), (-2.7, 0, 3.1), 0.14, PAINT),
        (rod, (-2.7, 0, 3.1), (-3.3, 0, 1.5), 0.11, PAINT),
        (side_profile, [(-3.6, 1.0), (-3.0, 1.1), (-2.9, 1.6), (-3.4, 1.6)], 0.35, WORN_STEEL),
        (block, (-1.7, 0, 0.7), (0.3, 2.1, 0.6), TRIM),
    ),
    "bulldozer": (
        (_track, 0.95, 3.4, 1.0, 0.55),
        (_track, -0.95, 3.4, 1.0, 0.55),
        (block, (0.9, 0, 1.35), (1.9, 1.2, 0.9), PAINT),
        (block, (-0.7, 0, 1.2), (1.6, 1.4, 0.7), PAINT),
        (_cabin, -0.6, 0, 1.4, (1.3, 1.4, 1.6)),
        (rod, (1.2, 0.35, 1.7), (1.2, 0.35, 2.5), 0.07, BLACK_RUBBER),
        (side_profile, [(2.2, 0.05), (2.45, 0.05), (2.35, 0.7), (2.5, 1.3), (2.2, 1.25)], 1.55, WORN_STEEL),
        *[(rod, (0.2, y, 0.6), (2.25, y, 0.5), 0.1, PAINT) for y in (-1.35, 1.35)],
    ),
    "roller": (
        (crossbar, 1.7, 0.72, 1.0, 0.72, WORN_STEEL, 14),
        (twin_blocks, (1.5, 1.06, 0.85), (1.9, 0.1, 0.25), PAINT),
        (block, (-1.3, 0, 1.3), (2.0, 1.5, 0.8), PAINT),
        (_cabin, 0.1, 0, 1.0, (1.2, 1.4, 1.9)),
        (axles, (-1.4,), 0.85, 0.7, 0.5),
    ),
    "crane": (
        (block, (0, 0, 0.95), (8.2, 2.4, 0.6), PAINT),
        (_cabin, 3.2, 0.4, 1.2, (1.5, 1.4, 1.3)),
        (axles, (-3.0, -1.6, 1.4, 2.8), 1.05, 0.6, 0.4),
        (block, (-1.2, 0, 1.8), (3.0, 2.0, 1.0), PAINT),
        (_cabin, -0.4, -0.6, 1.6, (1.3, 0.9, 1.5)),
        (rod, (-2.2, 0.2, 2.4), (4.6, 0.2, 3.5), 0.34, PAINT, 4),
        (rod, (3.8, 0.2, 3.36), (5.0, 0.2, 3.56), 0.22, WORN_STEEL, 4),
        (block, (-2.9, 0, 1.8), (0.7, 2.3, 1.0), TRIM),
    ),
    "mixer": (
        (side_profile, MIXER_DRUM, 0.95, CARGO),
        (block, (-0.6, 0, 0.95), (7.6, 1.0, 0.3), TRIM),
        (_cabin, 3.1, 0, 0.9, (1.7, 2.3, 1.9)),
        (block, (3.1, 0, 0.8), (2.0, 2.4, 0.7), PAINT),
        (axles, (-2.6, -1.3, 2.8), 1.05, 0.5, 0.35),
        (rod, (-3.6, 0, 2.9), (-4.3, 0, 1.6), 0.2, PAINT),
        *[(rod, (-3.2, y, 1.0), (-3.4, y * 0.3, 2.8), 0.07, PAINT) for y in (-0.8, 0.8)],
    ),
}  # of each construction vehicle

ORANGE: Color = (240, 92, 26)
WHITE: Color = (240, 240, 236)
RED: Color = (200, 36, 34)
CONE_NAMES = ("tall", "short", "slim", "drum", "lime")
BARRIER_NAMES = ("concrete", "plastic", "plank", "fence", "white_plastic")


def traffic_cone(name: str) -> list[Mesh]:
    """The parts of a traffic cone. name: one of CONE_NAMES."""
    if name == "drum":
        bands = [(0.2 * k, 0.2 * k + 0.2, 0.29 - 0.012 * k, 0.28 - 0.012 * k, (ORANGE, WHITE)[k % 2]) for k in range(5)]
        return [cone(*band, sections=10) for band in [(0, 0.06, 0.36, 0.36, BLACK_RUBBER), *bands]]
    height, foot, tip = {
        "tall": (0.95, 0.17, 0.03), "short": (0.6, 0.14, 0.03), "slim": (1.1, 0.09, 0.06), "lime": (0.75, 0.15, 0.03),
    }[name]  # fmt: skip
    color = ORANGE if name != "lime" else (196, 216, 40)
    parts = [block((0, 0, 0.025), (0.4, 0.4, 0.05), (30, 30, 32) if name != "short" else color)]
    for a, b, c in ((0.0, 0.4, color), (0.4, 0.58, WHITE), (0.58, 0.7, color), (0.7, 0.82, WHITE), (0.82, 1.0, color)):
        low, high = 0.04 + a * (height - 0.04), 0.04 + b * (height - 0.04)
        parts.append(cone(low, high, foot + (tip - foot) * a, foot + (tip - foot) * b, c))
    return parts


def barrier(name: str) -> list[Mesh]:
    """The parts of a barrier, about 0.5 m long (its thickness), 2.5 m wide and 1 m high. name: one of BARRIER_NAMES."""
    walls = {"concrete": ((172, 168, 160),), "plastic": (RED, WHITE) * 2, "white_plastic": (WHITE, RED) * 2}
    if name in walls:
        return _jersey(walls[name])
    feet = twin_blocks((0, 0.95, 0.05), (0.5, 0.14, 0.1), (46, 46, 48))
    if name == "plank":
        parts = [feet, twin_blocks((0, 0.95, 0.5), (0.06, 0.06, 1.0), (150, 152, 150))]
        for z, k in product((0.85, 0.45), range(10)):
            parts.append(block((0.04, -1.25 + 0.25 * (k + 0.5), z), (0.04, 0.25, 0.2), RED if k % 2 else WHITE))
        return parts
    parts = [block((0, 0, z), (0.05, 2.5, 0.06), (206, 208, 204)) for z in (0.2, 1.02)]
    parts += [block((0, -1.2 + 0.2 * k, 0.6), (0.03, 0.03, 0.84), (206, 208, 204)) for k in range(13)]
    return [feet, *parts, block((0.03, 0, 0.72), (0.03, 0.9, 0.3), ORANGE)]


def _jersey(colors: tuple[Color, ...]) -> list[Mesh]:
    """A wall along y with a sloped foot, in pieces of these colours."""
    side = [(0.28, 0.0), (0.26, 0.2), (0.1, 0.45), (0.08, 0.95)]
    outline = [(-0.28, 0.0), *side, *((-x, z) for x, z in side[:0:-1])]
    half = 1.25 / len(colors)
    return [side_profile(outline, half, paint, y=-1.25 + (2 * k + 1) * half) for k, paint in enumerate(colors)]


BARK: Color = (92, 74, 58)
GALVANISED_STEEL: Color = (112, 116, 120)
DARK: Color = (44, 46, 48)
LEAF_TONES: tuple[Color, ...] = ((86, 118, 52), (70, 104, 48), (110, 128, 58), (64, 92, 54), (140, 120, 52))
SIGN_RED, BLUE, SIGN_WHITE, OFF_WHITE = (190, 26, 30), (24, 84, 168), (240, 240, 238), (235, 235, 232)
SIGNS: tuple[tuple[int, Color, Color], ...] = (  # corners, colour of the rim and of the face
    (8, SIGN_RED, OFF_WHITE),
    (16, OFF_WHITE, SIGN_RED),
    (3, SIGN_RED, SIGN_WHITE),
    (4, BLUE, SIGN_WHITE),
    (4, (238, 190, 30), (30, 30, 30)),
    (4, BLUE, SIGN_WHITE),
)
TREE_KINDS = 12  # number of tree meshes


_GLOW = Finish((255, 236, 190), Material.GLOW)
_WOOD, _HYDRANT_RED = (134, 96, 62), (186, 44, 36)
OBJECTS: dict[str, tuple[Row, ...]] = {
    "lamp": (
        (cone, 0, 7.6, 0.1, 0.06, GALVANISED_STEEL, 6),
        (rod, (0, 0, 7.5), (1.8, 0, 7.9), 0.045, GALVANISED_STEEL, 5),
        (block, (2.1, 0, 7.9), (0.8, 0.26, 0.12), DARK),
        (block, (2.1, 0, 7.82), (0.6, 0.2, 0.05), _GLOW),
        (block, (0, 0, 0.3), (0.3, 0.3, 0.6), GALVANISED_STEEL),
    ),
    "bench": (
        (block, (0, 0, 0.45), (0.45, 1.7, 0.06), _WOOD),
        (block, (-0.24, 0, 0.75), (0.06, 1.7, 0.36), _WOOD),
        *[(block, (0, y, 0.22), (0.4, 0.06, 0.44), DARK) for y in (0.7, -0.7)],
    ),
    "litter bin": ((cone, 0, 0.9, 0.26, 0.3, (52, 84, 66)), (cone, 0.9, 1.0, 0.31, 0.2, DARK)),
    "hydrant": (
        (cone, 0, 0.6, 0.13, 0.12, _HYDRANT_RED),
        (ball, (0, 0, 0.62), (0.14, 0.14, 0.14), _HYDRANT_RED),
        (crossbar, 0, 0.45, 0.22, 0.06, _HYDRANT_RED),
    ),
    "bus shelter": (
        (block, (0, 0, 2.45), (1.5, 4.0, 0.1), DARK),
        (block, (-0.65, 0, 1.3), (0.04, 3.8, 1.9), Finish((60, 74, 80), Material.GLASS)),
        *[(rod, (x, y, 0), (x, y, 2.4), 0.05, DARK, 5) for x in (-0.65, 0.6) for y in (-1.9, 1.9)],
        (block, (-0.35, 0, 0.45), (0.35, 2.6, 0.06), _WOOD),
        (block, (0, 1.95, 1.3), (1.2, 0.08, 1.7), (210, 120, 70)),
    ),
}  # the lamp's arm reaches along x; a bench and the shelter with its glass back wall are open towards +x


class StreetFurniture:
    """The templates of all repeated objects. They do not depend on the drive."""

    def __init__(self) -> None:
        rng = np.random.Generator(np.random.PCG64(20))
        self.trees = [TriangleSoup.from_mesh(tree(k, rng)) for k in range(TREE_KINDS)]
        self.bushes = [TriangleSoup.from_mesh(bush(rng)) for _ in range(4)]
        self.signs = [_template(sign_post(k)) for k in range(6)]
        self.signals = {light: _template(signal_head(light)) for light in ("red", "yellow", "green")}
        self.lamp, *self.small, self.shelter = (_template(made(rows)) for rows in OBJECTS.values())


def _template(parts: list[Mesh]) -> TriangleSoup:
    return TriangleSoup.from_mesh(joined(parts))


def tree(variant: int, rng: np.random.Generator) -> Mesh:
    """A tree, 5 to 10 m high. variant: modulo 4: 0 and 1 round, 2 narrow, 3 conifer."""
    foliage = _foliage(rng)
    height = rng.uniform(5.5, 9.5)
    trunk = height * rng.uniform(0.32, 0.42)
    parts = [cone(0, trunk + 0.6, 0.16 + 0.008 * height, 0.1, BARK, sections=7)]
    if variant % 4 == 3:
        for k in range(3):
            low = trunk * 0.5 + k * height * 0.22
            parts.append(_crumpled(cone(low, low + height * 0.36, 1.7 - 0.42 * k, 0.05, foliage, 9), rng))
        return joined(parts)
    count, spread = (5, 1.2) if variant % 4 != 2 else (3, 0.5)
    for k in range(count):
        angle = 2 * np.pi * k / count + rng.uniform(-0.4, 0.4)
        radius = rng.uniform(1.2, 1.8)
        z = trunk + rng.uniform(0.7, 1.0) * (height - trunk) * (0.35 + 0.5 * (k % 2))
        center = (spread * np.cos(angle), spread * np.sin(angle), z)
        parts.append(_crumpled(ball(center, (radius, radius, radius * rng.uniform(0.75, 1.1)), foliage), rng))
    crown = ball((0, 0, height - 1.6), (1.5, 1.5, 1.6), foliage)
    return joined([*parts, _crumpled(crown, rng)])


def _foliage(rng: np.random.Generator) -> Finish:
    return Finish(LEAF_TONES[int(rng.integers(len(LEAF_TONES)))], Material.LEAVES)


def _crumpled(crown: Mesh, rng: np.random.Generator) -> Mesh:
    """Move the corners of a crown at random, shared corners together, and vary the brightness of its faces."""
    points = crown.faces.reshape(-1, 3)
    unique, where = np.unique(np.round(points, 3), axis=0, return_inverse=True)
    middle = unique.mean(0)
    crumpled = middle + (unique - middle) * rng.uniform(0.82, 1.2, (len(unique), 1))
    faces = crumpled[where.reshape(-1)].reshape(-1, 3, 3).astype(np.float32)
    tone = rng.uniform(0.72, 1.25, (len(faces), 1)).astype(np.float32)
    return Mesh(faces, crown.albedo * tone, crown.material)


def bush(rng: np.random.Generator) -> Mesh:
    """A low shrub, about 1 m high."""
    foliage = _foliage(rng)
    parts = [ball((x, rng.uniform(-0.2, 0.2), 0.45), (0.55, 0.5, 0.5), foliage) for x in (-0.5, 0.3)]
    return _crumpled(joined(parts), rng)


def sign_post(kind: int) -> list[Mesh]:
    """A traffic sign that faces along x. kind: 0 stop, 1 speed limit, 2 yield, 3 direction, 4 warning, 5 parking."""
    pole = rod((0, 0, 0), (0, 0, 2.6), 0.035, GALVANISED_STEEL, sections=5)
    sides, outer, inner = SIGNS[kind]
    disc = rod((0.04, 0, 2.4), (0.07, 0, 2.4), 0.38, outer, sections=sides)
    face = rod((0.065, 0, 2.4), (0.085, 0, 2.4), 0.27, inner, sections=sides)
    if kind in (0, 3, 5):
        face = block((0.08, 0, 2.4), (0.03, 0.5, 0.14) if kind == 0 else (0.03, 0.1, 0.32), inner)
    return [pole, disc, face]


def signal_head(lit: str) -> list[Mesh]:
    """A traffic signal that faces along x, on a pole with an arm towards +y. lit: red, yellow or green."""
    lamps: dict[str, tuple[Color, Color]] = {
        "red": ((255, 40, 30), (60, 14, 14)),
        "yellow": ((255, 190, 40), (58, 44, 12)),
        "green": ((50, 255, 140), (10, 48, 30)),
    }
    parts = [cone(0, 6.0, 0.1, 0.07, DARK, sections=6), rod((0, 0, 5.8), (0, 3.6, 5.9), 0.05, DARK, sections=5)]
    for y, z in ((3.4, 5.35), (0.22, 2.7)):
        parts.append(block((0.1, y, z), (0.24, 0.36, 1.05), (24, 26, 26)))
        for k, (name, (on, off)) in enumerate(lamps.items()):
            surface = Finish(on, Material.GLOW) if name == lit else off
            parts.append(rod((0.2, y, z + 0.33 - 0.33 * k), (0.25, y, z + 0.33 - 0.33 * k), 0.12, surface, 8))
    return parts
