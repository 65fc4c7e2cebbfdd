"""The catalog of objects.

Annotated objects: the variants of each class, and a drawn individual of a variant. Here are the meshes of those that
stand still: machines, cones and barriers, whose long side is their width, as in nuScenes annotations.
Street furniture, which is not annotated: trees, lamps, signs, benches, traffic signals.
"""

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field
from itertools import product

import numpy as np
from numpy.typing import NDArray

from bevcli.workshop.synth import mesh, road_users
from bevcli.workshop.synth.road_users import CYCLES, RIDDEN

Colors = tuple[mesh.Color, ...]
WORN_STEEL = (96, 96, 98)
BLACK_RUBBER = (30, 30, 32)


def _cabin(x: float, y: float, bottom: float, size: tuple[float, float, float]) -> mesh.Mesh:
    length, width, height = size
    posts = [(x + sx * length, y + sy * width) for sx in (-0.5, 0.5) for sy in (-0.5, 0.5)]
    parts = [
        mesh.block((x, y, bottom + height * 0.15), (length, width, height * 0.3), mesh.PAINT),
        mesh.block((x, y, bottom + height * 0.62), (length * 0.94, width * 0.94, height * 0.66), mesh.GLASS),
        mesh.block((x, y, bottom + height), (length * 1.06, width * 1.06, 0.1), mesh.PAINT),
    ]
    return mesh.joined(
        [*parts, *(mesh.rod((*at, bottom), (*at, bottom + height), 0.05, mesh.TRIM, sections=4) for at in posts)]
    )


def _track(y: float, length: float, height: float, width: float) -> mesh.Mesh:
    half, foot, shoulder = length / 2, length / 2 - height / 2, length / 2 - height * 0.35
    outline = [
        (-foot, 0), (foot, 0), (half, height * 0.5), (shoulder, height), (-shoulder, height), (-half, height * 0.5),
    ]  # fmt: skip
    start, end, z = y - width / 2 - 0.02, y + width / 2 + 0.02, height * 0.45
    positions = (-half * 0.7, -half * 0.25, half * 0.25, half * 0.7)
    rollers = [mesh.rod((x, start, z), (x, end, z), height * 0.3, WORN_STEEL, sections=8) for x in positions]
    return mesh.joined([mesh.side_profile(outline, width / 2, BLACK_RUBBER, y=y), *rollers])


MIXER_DRUM = [(-3.6, 1.6), (-2.0, 1.25), (0.6, 1.35), (1.2, 1.9), (0.9, 2.9), (-1.0, 3.2), (-3.4, 2.6)]
MACHINES: dict[str, tuple[mesh.Row, ...]] = {
    "excavator": (
        (_track, 1.05, 3.6, 0.85, 0.5),
        (_track, -1.05, 3.6, 0.85, 0.5),
        (mesh.block, (0, 0, 0.75), (2.0, 1.6, 0.4), mesh.TRIM),
        (mesh.block, (-0.9, 0, 1.5), (2.2, 2.5, 1.1), mesh.PAINT),
        (mesh.block, (-1.9, 0, 1.5), (0.5, 2.4, 1.0), mesh.TRIM),
        (_cabin, 0.6, 0.7, 1.0, (1.4, 1.0, 1.9)),
        (mesh.rod, (0.6, -0.3, 1.5), (2.6, -0.3, 3.3), 0.2, mesh.PAINT, 6),
        (mesh.rod, (2.6, -0.3, 3.3), (3.9, -0.3, 1.6), 0.16, mesh.PAINT, 6),
        (mesh.rod, (0.9, -0.3, 2.3), (2.1, -0.3, 3.1), 0.08, (200, 200, 202)),
        (mesh.side_profile, [(3.6, 1.6), (4.2, 1.5), (3.9, 0.6), (3.2, 0.5), (3.2, 0.9)], 0.5, WORN_STEEL, -0.3),
    ),
    "loader": (
        (mesh.block, (-1.7, 0, 1.5), (2.0, 1.9, 1.1), mesh.PAINT),
        (mesh.block, (0.6, 0, 1.1), (2.4, 1.2, 0.6), mesh.PAINT),
        (mesh.block, (-2.7, 0, 1.3), (0.2, 2.0, 0.8), mesh.TRIM),
        (_cabin, -0.3, 0, 1.5, (1.3, 1.4, 1.7)),
        (mesh.axles, (-1.7, 1.4), 1.0, 0.75, 0.55, (220, 190, 60)),
        *[(mesh.rod, (0.6, y, 1.6), (2.7, y, 0.7), 0.11, mesh.PAINT) for y in (-0.6, 0.6)],
        (mesh.side_profile, [(2.6, 0.15), (3.6, 0.1), (3.5, 0.3), (2.9, 1.1), (2.6, 1.1)], 1.35, WORN_STEEL),
    ),
    "backhoe": (
        (mesh.block, (0.9, 0, 1.2), (2.0, 1.0, 0.7), mesh.PAINT),
        (_cabin, -0.6, 0, 0.9, (1.5, 1.6, 1.9)),
        (mesh.axles, (-1.1,), 0.9, 0.72, 0.5, (220, 190, 60)),
        (mesh.axles, (1.4,), 0.85, 0.48, 0.35, (220, 190, 60)),
        *[(mesh.rod, (0.9, y, 1.3), (2.5, y, 0.6), 0.09, mesh.PAINT) for y in (-0.6, 0.6)],
        (mesh.side_profile, [(2.4, 0.1), (3.2, 0.1), (3.1, 0.3), (2.6, 0.9), (2.4, 0.9)], 1.15, WORN_STEEL),
        (mesh.rod, (-1.6, 0, 1.0), (-2.7, 0, 3.1), 0.14, mesh.PAINT),
        (mesh.rod, (-2.7, 0, 3.1), (-3.3, 0, 1.5), 0.11, mesh.PAINT),
        (mesh.side_profile, [(-3.6, 1.0), (-3.0, 1.1), (-2.9, 1.6), (-3.4, 1.6)], 0.35, WORN_STEEL),
        (mesh.block, (-1.7, 0, 0.7), (0.3, 2.1, 0.6), mesh.TRIM),
    ),
    "bulldozer": (
        (_track, 0.95, 3.4, 1.0, 0.55),
        (_track, -0.95, 3.4, 1.0, 0.55),
        (mesh.block, (0.9, 0, 1.35), (1.9, 1.2, 0.9), mesh.PAINT),
        (mesh.block, (-0.7, 0, 1.2), (1.6, 1.4, 0.7), mesh.PAINT),
        (_cabin, -0.6, 0, 1.4, (1.3, 1.4, 1.6)),
        (mesh.rod, (1.2, 0.35, 1.7), (1.2, 0.35, 2.5), 0.07, BLACK_RUBBER),
        (mesh.side_profile, [(2.2, 0.05), (2.45, 0.05), (2.35, 0.7), (2.5, 1.3), (2.2, 1.25)], 1.55, WORN_STEEL),
        *[(mesh.rod, (0.2, y, 0.6), (2.25, y, 0.5), 0.1, mesh.PAINT) for y in (-1.35, 1.35)],
    ),
    "roller": (
        (mesh.crossbar, 1.7, 0.72, 1.0, 0.72, WORN_STEEL, 14),
        (mesh.twin_blocks, (1.5, 1.06, 0.85), (1.9, 0.1, 0.25), mesh.PAINT),
        (mesh.block, (-1.3, 0, 1.3), (2.0, 1.5, 0.8), mesh.PAINT),
        (_cabin, 0.1, 0, 1.0, (1.2, 1.4, 1.9)),
        (mesh.axles, (-1.4,), 0.85, 0.7, 0.5),
    ),
    "crane": (
        (mesh.block, (0, 0, 0.95), (8.2, 2.4, 0.6), mesh.PAINT),
        (_cabin, 3.2, 0.4, 1.2, (1.5, 1.4, 1.3)),
        (mesh.axles, (-3.0, -1.6, 1.4, 2.8), 1.05, 0.6, 0.4),
        (mesh.block, (-1.2, 0, 1.8), (3.0, 2.0, 1.0), mesh.PAINT),
        (_cabin, -0.4, -0.6, 1.6, (1.3, 0.9, 1.5)),
        (mesh.rod, (-2.2, 0.2, 2.4), (4.6, 0.2, 3.5), 0.34, mesh.PAINT, 4),
        (mesh.rod, (3.8, 0.2, 3.36), (5.0, 0.2, 3.56), 0.22, WORN_STEEL, 4),
        (mesh.block, (-2.9, 0, 1.8), (0.7, 2.3, 1.0), mesh.TRIM),
    ),
    "mixer": (
        (mesh.side_profile, MIXER_DRUM, 0.95, mesh.CARGO),
        (mesh.block, (-0.6, 0, 0.95), (7.6, 1.0, 0.3), mesh.TRIM),
        (_cabin, 3.1, 0, 0.9, (1.7, 2.3, 1.9)),
        (mesh.block, (3.1, 0, 0.8), (2.0, 2.4, 0.7), mesh.PAINT),
        (mesh.axles, (-2.6, -1.3, 2.8), 1.05, 0.5, 0.35),
        (mesh.rod, (-3.6, 0, 2.9), (-4.3, 0, 1.6), 0.2, mesh.PAINT),
        *[(mesh.rod, (-3.2, y, 1.0), (-3.4, y * 0.3, 2.8), 0.07, mesh.PAINT) for y in (-0.8, 0.8)],
    ),
}  # of each construction vehicle

ORANGE: mesh.Color = (240, 92, 26)
WHITE: mesh.Color = (240, 240, 236)
RED: mesh.Color = (200, 36, 34)
CONE_NAMES = ("tall", "short", "slim", "drum", "lime")
BARRIER_NAMES = ("concrete", "plastic", "plank", "fence", "white_plastic")


def traffic_cone(name: str) -> list[mesh.Mesh]:
    """The parts of a traffic cone. name: one of CONE_NAMES."""
    if name == "drum":
        bands = [(0.2 * k, 0.2 * k + 0.2, 0.29 - 0.012 * k, 0.28 - 0.012 * k, (ORANGE, WHITE)[k % 2]) for k in range(5)]
        return [mesh.cone(*band, sections=10) for band in [(0, 0.06, 0.36, 0.36, BLACK_RUBBER), *bands]]
    height, foot, tip = {
        "tall": (0.95, 0.17, 0.03), "short": (0.6, 0.14, 0.03), "slim": (1.1, 0.09, 0.06), "lime": (0.75, 0.15, 0.03),
    }[name]  # fmt: skip
    color = ORANGE if name != "lime" else (196, 216, 40)
    parts = [mesh.block((0, 0, 0.025), (0.4, 0.4, 0.05), (30, 30, 32) if name != "short" else color)]
    for a, b, c in ((0.0, 0.4, color), (0.4, 0.58, WHITE), (0.58, 0.7, color), (0.7, 0.82, WHITE), (0.82, 1.0, color)):
        low, high = 0.04 + a * (height - 0.04), 0.04 + b * (height - 0.04)
        parts.append(mesh.cone(low, high, foot + (tip - foot) * a, foot + (tip - foot) * b, c))
    return parts


def barrier(name: str) -> list[mesh.Mesh]:
    """The parts of a barrier, about 0.5 m long (its thickness), 2.5 m wide and 1 m high. name: one of BARRIER_NAMES."""
    walls = {"concrete": ((172, 168, 160),), "plastic": (RED, WHITE) * 2, "white_plastic": (WHITE, RED) * 2}
    if name in walls:
        foot = [(0.28, 0.0), (0.26, 0.2), (0.1, 0.45), (0.08, 0.95)]  # sloped
        outline = [(-0.28, 0.0), *foot, *((-x, z) for x, z in foot[:0:-1])]
        half = 1.25 / len(walls[name])
        pieces = enumerate(walls[name])
        return [mesh.side_profile(outline, half, paint, y=-1.25 + (2 * k + 1) * half) for k, paint in pieces]
    feet = mesh.twin_blocks((0, 0.95, 0.05), (0.5, 0.14, 0.1), (46, 46, 48))
    if name == "plank":
        parts = [feet, mesh.twin_blocks((0, 0.95, 0.5), (0.06, 0.06, 1.0), (150, 152, 150))]
        for z, k in product((0.85, 0.45), range(10)):
            parts.append(mesh.block((0.04, -1.25 + 0.25 * (k + 0.5), z), (0.04, 0.25, 0.2), RED if k % 2 else WHITE))
        return parts
    parts = [mesh.block((0, 0, z), (0.05, 2.5, 0.06), (206, 208, 204)) for z in (0.2, 1.02)]
    parts += [mesh.block((0, -1.2 + 0.2 * k, 0.6), (0.03, 0.03, 0.84), (206, 208, 204)) for k in range(13)]
    return [feet, *parts, mesh.block((0.03, 0, 0.72), (0.03, 0.9, 0.3), ORANGE)]


BARK: mesh.Color = (92, 74, 58)
GALVANISED_STEEL: mesh.Color = (112, 116, 120)
DARK: mesh.Color = (44, 46, 48)
LEAF_TONES: Colors = ((86, 118, 52), (70, 104, 48), (110, 128, 58), (64, 92, 54), (140, 120, 52))
SIGN_RED, BLUE, SIGN_WHITE, OFF_WHITE = (190, 26, 30), (24, 84, 168), (240, 240, 238), (235, 235, 232)
SIGNS: tuple[tuple[int, mesh.Color, mesh.Color], ...] = (  # corners, colour of the rim and of the face
    (8, SIGN_RED, OFF_WHITE),
    (16, OFF_WHITE, SIGN_RED),
    (3, SIGN_RED, SIGN_WHITE),
    (4, BLUE, SIGN_WHITE),
    (4, (238, 190, 30), (30, 30, 30)),
    (4, BLUE, SIGN_WHITE),
)
TREE_KINDS = 12  # number of tree meshes


_GLOW = mesh.Finish((255, 236, 190), mesh.Material.GLOW)
_WOOD, _HYDRANT_RED = (134, 96, 62), (186, 44, 36)
OBJECTS: dict[str, tuple[mesh.Row, ...]] = {
    "lamp": (
        (mesh.cone, 0, 7.6, 0.1, 0.06, GALVANISED_STEEL, 6),
        (mesh.rod, (0, 0, 7.5), (1.8, 0, 7.9), 0.045, GALVANISED_STEEL, 5),
        (mesh.block, (2.1, 0, 7.9), (0.8, 0.26, 0.12), DARK),
        (mesh.block, (2.1, 0, 7.82), (0.6, 0.2, 0.05), _GLOW),
        (mesh.block, (0, 0, 0.3), (0.3, 0.3, 0.6), GALVANISED_STEEL),
    ),
    "bench": (
        (mesh.block, (0, 0, 0.45), (0.45, 1.7, 0.06), _WOOD),
        (mesh.block, (-0.24, 0, 0.75), (0.06, 1.7, 0.36), _WOOD),
        *[(mesh.block, (0, y, 0.22), (0.4, 0.06, 0.44), DARK) for y in (0.7, -0.7)],
    ),
    "litter bin": ((mesh.cone, 0, 0.9, 0.26, 0.3, (52, 84, 66)), (mesh.cone, 0.9, 1.0, 0.31, 0.2, DARK)),
    "hydrant": (
        (mesh.cone, 0, 0.6, 0.13, 0.12, _HYDRANT_RED),
        (mesh.ball, (0, 0, 0.62), (0.14, 0.14, 0.14), _HYDRANT_RED),
        (mesh.crossbar, 0, 0.45, 0.22, 0.06, _HYDRANT_RED),
    ),
    "bus shelter": (
        (mesh.block, (0, 0, 2.45), (1.5, 4.0, 0.1), DARK),
        (mesh.block, (-0.65, 0, 1.3), (0.04, 3.8, 1.9), mesh.Finish((60, 74, 80), mesh.Material.GLASS)),
        *[(mesh.rod, (x, y, 0), (x, y, 2.4), 0.05, DARK, 5) for x in (-0.65, 0.6) for y in (-1.9, 1.9)],
        (mesh.block, (-0.35, 0, 0.45), (0.35, 2.6, 0.06), _WOOD),
        (mesh.block, (0, 1.95, 1.3), (1.2, 0.08, 1.7), (210, 120, 70)),
    ),
}  # the lamp's arm reaches along x; a bench and the shelter with its glass back wall are open towards +x


class StreetFurniture:
    """The templates of all repeated objects. They do not depend on the drive."""

    def __init__(self) -> None:
        rng = np.random.Generator(np.random.PCG64(20))
        self.trees = [mesh.TriangleSoup.from_mesh(tree(k, rng)) for k in range(TREE_KINDS)]
        self.bushes = [mesh.TriangleSoup.from_mesh(bush(rng)) for _ in range(4)]
        self.signs = [_template(sign_post(k)) for k in range(6)]
        self.signals = {light: _template(signal_head(light)) for light in ("red", "yellow", "green")}
        self.lamp, *self.small, self.shelter = (_template(mesh.made(rows)) for rows in OBJECTS.values())


def _template(parts: list[mesh.Mesh]) -> mesh.TriangleSoup:
    return mesh.TriangleSoup.from_mesh(mesh.joined(parts))


def tree(variant: int, rng: np.random.Generator) -> mesh.Mesh:
    """A tree, 5 to 10 m high. variant: modulo 4: 0 and 1 round, 2 narrow, 3 conifer."""
    foliage = _foliage(rng)
    height = rng.uniform(5.5, 9.5)
    trunk = height * rng.uniform(0.32, 0.42)
    parts = [mesh.cone(0, trunk + 0.6, 0.16 + 0.008 * height, 0.1, BARK, sections=7)]
    if variant % 4 == 3:
        for k in range(3):
            low = trunk * 0.5 + k * height * 0.22
            parts.append(_crumpled(mesh.cone(low, low + height * 0.36, 1.7 - 0.42 * k, 0.05, foliage, 9), rng))
        return mesh.joined(parts)
    count, spread = (5, 1.2) if variant % 4 != 2 else (3, 0.5)
    for k in range(count):
        angle = 2 * np.pi * k / count + rng.uniform(-0.4, 0.4)
        radius = rng.uniform(1.2, 1.8)
        z = trunk + rng.uniform(0.7, 1.0) * (height - trunk) * (0.35 + 0.5 * (k % 2))
        center = (spread * np.cos(angle), spread * np.sin(angle), z)
        parts.append(_crumpled(mesh.ball(center, (radius, radius, radius * rng.uniform(0.75, 1.1)), foliage), rng))
    crown = mesh.ball((0, 0, height - 1.6), (1.5, 1.5, 1.6), foliage)
    return mesh.joined([*parts, _crumpled(crown, rng)])


def _foliage(rng: np.random.Generator) -> mesh.Finish:
    return mesh.Finish(LEAF_TONES[int(rng.integers(len(LEAF_TONES)))], mesh.Material.LEAVES)


def _crumpled(crown: mesh.Mesh, rng: np.random.Generator) -> mesh.Mesh:
    """Move the corners of a crown at random, shared corners together, and vary the brightness of its faces."""
    points = crown.faces.reshape(-1, 3)
    unique, corner_of = np.unique(np.round(points, 3), axis=0, return_inverse=True)
    middle = unique.mean(0)
    crumpled = middle + (unique - middle) * rng.uniform(0.82, 1.2, (len(unique), 1))
    faces = crumpled[corner_of.reshape(-1)].reshape(-1, 3, 3).astype(np.float32)
    tone = rng.uniform(0.72, 1.25, (len(faces), 1)).astype(np.float32)
    return mesh.Mesh(faces, crown.albedo * tone, crown.material)


def bush(rng: np.random.Generator) -> mesh.Mesh:
    """A low shrub, about 1 m high."""
    foliage = _foliage(rng)
    parts = [mesh.ball((x, rng.uniform(-0.2, 0.2), 0.45), (0.55, 0.5, 0.5), foliage) for x in (-0.5, 0.3)]
    return _crumpled(mesh.joined(parts), rng)


def sign_post(kind: int) -> list[mesh.Mesh]:
    """A traffic sign that faces along x. kind: 0 stop, 1 speed limit, 2 yield, 3 direction, 4 warning, 5 parking."""
    pole = mesh.rod((0, 0, 0), (0, 0, 2.6), 0.035, GALVANISED_STEEL, sections=5)
    sides, outer, inner = SIGNS[kind]
    disc = mesh.rod((0.04, 0, 2.4), (0.07, 0, 2.4), 0.38, outer, sections=sides)
    face = mesh.rod((0.065, 0, 2.4), (0.085, 0, 2.4), 0.27, inner, sections=sides)
    if kind in (0, 3, 5):
        face = mesh.block((0.08, 0, 2.4), (0.03, 0.5, 0.14) if kind == 0 else (0.03, 0.1, 0.32), inner)
    return [pole, disc, face]


def signal_head(lit: str) -> list[mesh.Mesh]:
    """A traffic signal that faces along x, on a pole with an arm towards +y. lit: red, yellow or green."""
    lamps: dict[str, tuple[mesh.Color, mesh.Color]] = {
        "red": ((255, 40, 30), (60, 14, 14)),
        "yellow": ((255, 190, 40), (58, 44, 12)),
        "green": ((50, 255, 140), (10, 48, 30)),
    }
    parts = [
        mesh.cone(0, 6.0, 0.1, 0.07, DARK, sections=6),
        mesh.rod((0, 0, 5.8), (0, 3.6, 5.9), 0.05, DARK, sections=5),
    ]
    for y, z in ((3.4, 5.35), (0.22, 2.7)):
        parts.append(mesh.block((0.1, y, z), (0.24, 0.36, 1.05), (24, 26, 26)))
        for k, (name, (on, off)) in enumerate(lamps.items()):
            surface = mesh.Finish(on, mesh.Material.GLOW) if name == lit else off
            parts.append(mesh.rod((0.2, y, z + 0.33 - 0.33 * k), (0.25, y, z + 0.33 - 0.33 * k), 0.12, surface, 8))
    return parts


def any_color(rng: np.random.Generator) -> NDArray[np.float32]:
    """(3,) linear RGB of any brightness; greys are frequent."""
    grey = rng.random() ** 2
    color = grey + (rng.random(3) - grey) * rng.random()
    return np.asarray(0.02 + 0.9 * color, np.float32)


def nameless(rng: np.random.Generator) -> mesh.Mesh:
    """One to four blocks, balls, cones and poles on top of each other or side by side, 0.3 to 5 m."""
    parts = []
    for _ in range(int(rng.integers(1, 5))):
        length, width, height = np.exp(rng.uniform(np.log(0.2), np.log((3.0, 1.2, 3.0))))
        x, y, low = *rng.uniform(-0.5, 0.5, 2), float(rng.uniform(0, 1)) * (rng.random() < 0.4)
        red, green, blue = (int(255 * c) for c in any_color(rng) ** 0.45)
        color: mesh.Color = (red, green, blue)
        kind = rng.integers(4)
        if kind == 0:
            parts.append(mesh.block((x, y, low + height / 2), (length, width, height), color))
        elif kind == 1:
            parts.append(mesh.ball((x, y, low + height / 2), (length / 2, width / 2, height / 2), color))
        elif kind == 2:
            parts.append(mesh.cone(low, low + height, width / 2, width / 2 * float(rng.random()) + 0.01, color))
        else:
            parts.append(mesh.rod((x, y, 0), (x + rng.uniform(-1, 1), y, height + 1), 0.03 + 0.1 * rng.random(), color))
    return mesh.joined(parts)


# Colours to draw from.
CAR_PAINTS: Colors = (
    (235, 236, 238), (196, 199, 203), (120, 124, 130), (62, 66, 72), (26, 28, 32), (170, 28, 30), (120, 22, 30),
    (28, 60, 128), (52, 108, 176), (22, 40, 70), (34, 84, 62), (214, 178, 40), (204, 98, 32), (150, 132, 104),
    (108, 80, 58), (92, 132, 142),
)  # fmt: skip
TRUCK_PAINTS: Colors = (
    (238, 238, 236), (228, 228, 224), (196, 40, 34), (30, 84, 160), (226, 168, 30), (44, 112, 72), (104, 108, 112),
    (232, 120, 36),
)  # fmt: skip
BUS_PAINTS: Colors = (
    (224, 60, 44), (36, 98, 176), (240, 190, 40), (240, 240, 236), (48, 140, 92), (128, 52, 120), (52, 168, 178),
)  # fmt: skip
MACHINE_PAINTS: Colors = ((236, 176, 24), (232, 140, 20), (222, 92, 28), (236, 200, 60), (188, 190, 60))
CLOTHES: Colors = (
    (40, 42, 48), (70, 76, 88), (132, 136, 142), (204, 202, 196), (150, 40, 44), (40, 70, 130), (78, 112, 160),
    (58, 96, 70), (188, 148, 60), (120, 72, 110), (196, 112, 92), (96, 76, 60),
)  # fmt: skip
MODEL_SHARES = {
    "car": 0.65, "truck": 0.35, "bus": 0.35, "motorcycle": 0.15, "pedestrian": 0.55, "barrier": 0.15,
    "traffic_cone": 0.2,
}  # share of the individuals of a class that are models, where there are models  # fmt: skip
WITHOUT_MODELS = ("tractor", "worker", "rider")  # looks that are always ours
OWN_PAINTS: dict[str, Colors] = dict.fromkeys(("taxi", "school"), ((238, 190, 30),))  # by look


@dataclass(frozen=True)
class Variant:
    """One look of a class."""

    class_name: str  # one of the ten nuScenes classes
    name: str  # the look, such as "sedan" or "city_rider"; unique within the class
    poses: tuple[mesh.Mesh, ...]  # meshes of one size, shown in turn while the object moves
    size_lwh: NDArray[np.float64]  # (3,) usual length, width and height, metres
    paints: Colors  # colours to draw from for PAINT faces
    dyes: Colors  # colours to draw from for DYE faces
    share: float = 1.0  # how often it is drawn, relative to the other models of its class
    shaded: bool = False  # whether the albedo of PAINT and DYE faces is a factor on the drawn colours


@dataclass(frozen=True, eq=False)
class Body:
    """An individual of a variant, with its own size and colours."""

    variant: Variant  # the look
    size_lwh: NDArray[np.float64]  # (3,) length, width and height, metres; the mesh is stretched to it
    paint: NDArray[np.float32]  # (3,) linear RGB of PAINT faces
    dye: NDArray[np.float32]  # (3,) linear RGB of DYE faces
    instance: str  # the ground truth instance name, unique in a drive


def draw_body(
    variant: Variant, rng: np.random.Generator, instance: str, spread: float = 0.05, scale: float = 1.0
) -> Body:
    """Draw an individual of a variant.

    spread: each dimension is drawn from 1 - spread to 1 + spread times the usual one. scale: factor on all dimensions.
    """
    size = variant.size_lwh * rng.uniform(1 - spread, 1 + spread, 3) * scale
    paint = variant.paints[int(rng.integers(len(variant.paints)))]
    dye = variant.dyes[int(rng.integers(len(variant.dyes)))]
    return Body(variant, size, mesh.linear(paint), mesh.linear(dye), instance)


# The classes but pedestrians: the names of the looks, the function that makes their parts, paints, dyes.
_CLASSES: dict[str, tuple[Iterable[str], Callable[[str], list[mesh.Mesh]], Colors, Colors]] = {
    "car": (road_users.CAR_SHAPES, road_users.car, CAR_PAINTS, CAR_PAINTS),
    "truck": (road_users.TRUCK_NAMES, road_users.truck, TRUCK_PAINTS, TRUCK_PAINTS),
    "construction_vehicle": (MACHINES, lambda look: mesh.made(MACHINES[look]), MACHINE_PAINTS, TRUCK_PAINTS),
    "bus": (road_users.BUSES, road_users.bus, BUS_PAINTS, BUS_PAINTS),
    "trailer": (road_users.TRAILER_NAMES, road_users.trailer, TRUCK_PAINTS, TRUCK_PAINTS),
    "barrier": (BARRIER_NAMES, barrier, CAR_PAINTS, CLOTHES),
    "motorcycle": (CYCLES["motorcycle"] + RIDDEN["motorcycle"], road_users.motorcycle, CAR_PAINTS, CLOTHES),
    "bicycle": (CYCLES["bicycle"] + RIDDEN["bicycle"], road_users.bicycle, CAR_PAINTS, CLOTHES),
    "traffic_cone": (CONE_NAMES, traffic_cone, CAR_PAINTS, CLOTHES),
}

COLORS: dict[str, tuple[Colors, Colors]] = {
    **{name: (paints, dyes) for name, (_, _, paints, dyes) in _CLASSES.items()}, "pedestrian": (CLOTHES, CLOTHES),
}  # paints and dyes of each class  # fmt: skip


@dataclass(frozen=True)
class Assets:
    """The meshes that all drives share. Build them once and pass them to every drive."""

    by_class: Mapping[str, tuple[Variant, ...]]  # all variants of the annotated objects, by class
    furniture: StreetFurniture  # the repeated objects without annotations
    models: Mapping[str, tuple[Variant, ...]] = field(default_factory=dict)  # by class, drawn in place of variants

    @staticmethod
    def build() -> "Assets":
        """Build every mesh. This takes about half a second."""
        by_class: dict[str, tuple[Variant, ...]] = {}
        for name, (looks, make, paints, dyes) in _CLASSES.items():
            meshes = {look: mesh.joined(make(look)) for look in looks}
            by_class[name] = tuple(
                Variant(name, look, (whole,), whole.extents, OWN_PAINTS.get(look, paints), dyes)
                for look, whole in meshes.items()
            )
        # A walking person has two mirrored strides of the same size.
        people = [_person(name, *strides) for strides in ((1, -1), (0,)) for name in road_users.PERSON_NAMES]
        return Assets({**by_class, "pedestrian": tuple(people)}, StreetFurniture())

    def draw(self, class_name: str, rng: np.random.Generator, names: Collection[str] | None = None) -> Variant:
        """Draw a variant of a class. names: draw from these variants only."""
        choices = [v for v in self.by_class[class_name] if names is None or v.name in names]
        chosen = choices[int(rng.integers(len(choices)))]
        models = self._models(class_name, names or ())
        if models and rng.random() < MODEL_SHARES.get(class_name, 0.0):
            shares = np.array([model.share for model in models])
            return models[int(rng.choice(len(models), p=shares / shares.sum()))]
        return chosen

    def _models(self, class_name: str, names: Collection[str]) -> list[Variant]:
        """The models that may stand for variants of these names: in the same pose, and none for a special look."""
        if any(part in name for name in names for part in WITHOUT_MODELS):
            return []
        standing = any(name.endswith("_standing") for name in names)
        return [m for m in self.models.get(class_name, ()) if m.name.endswith("_standing") == standing]


def _person(name: str, *strides: int) -> Variant:
    poses = tuple(mesh.joined(road_users.person(name, stride)) for stride in strides)
    size = poses[0].extents * (0.68 if name == "child" else 1.0)
    return Variant("pedestrian", name if any(strides) else f"{name}_standing", poses, size, CLOTHES, CLOTHES)
