"""Meshes of objects that are not annotated: trees, lamps, signs, traffic signals, benches, bins."""

import numpy as np

from bevcli.workshop.synth.assets.mesh import Mesh, Row, TriangleSoup, ball, block, cone, crossbar, joined, made, rod
from bevcli.workshop.synth.assets.paint import Color, Finish, Material

BARK: Color = (92, 74, 58)
GALVANISED_STEEL: Color = (112, 116, 120)
DARK: Color = (44, 46, 48)
LEAF_TONES: tuple[Color, ...] = ((86, 118, 52), (70, 104, 48), (110, 128, 58), (64, 92, 54), (140, 120, 52))
RED, BLUE, WHITE, OFF_WHITE = (190, 26, 30), (24, 84, 168), (240, 240, 238), (235, 235, 232)
SIGNS: tuple[tuple[int, Color, Color], ...] = (  # corners, colour of the rim and of the face
    (8, RED, OFF_WHITE),
    (16, OFF_WHITE, RED),
    (3, RED, WHITE),
    (4, BLUE, WHITE),
    (4, (238, 190, 30), (30, 30, 30)),
    (4, BLUE, WHITE),
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
