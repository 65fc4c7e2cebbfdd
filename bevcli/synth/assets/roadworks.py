"""Meshes of traffic cones and barriers. A barrier's long side is its width, as in nuScenes annotations."""

from __future__ import annotations

from bevcli.synth.assets.mesh import Mesh, block, cone, joined, side_profile
from bevcli.synth.assets.paint import Color

ORANGE: Color = (240, 92, 26)
WHITE: Color = (240, 240, 236)
RED: Color = (200, 36, 34)
CONE_NAMES = ("tall", "short", "slim", "drum", "lime")
BARRIER_NAMES = ("concrete", "plastic", "plank", "fence", "white_plastic")


def traffic_cone(name: str) -> Mesh:
    """The mesh of a traffic cone. name: one of CONE_NAMES."""
    if name == "drum":
        bands = [
            cone(
                0,
                0,
                0.2 * k,
                0.2 * k + 0.2,
                0.29 - 0.012 * k,
                0.28 - 0.012 * k,
                ORANGE if k % 2 == 0 else WHITE,
                sections=10,
            )
            for k in range(5)
        ]
        return joined([cone(0, 0, 0, 0.06, 0.36, 0.36, (30, 30, 32), sections=10), *bands])
    height = {"tall": 0.95, "short": 0.6, "slim": 1.1, "lime": 0.75}[name]
    foot = {"tall": 0.17, "short": 0.14, "slim": 0.09, "lime": 0.15}[name]
    color = ORANGE if name != "lime" else (196, 216, 40)
    tip = 0.03 if name != "slim" else 0.06

    def radius(fraction: float) -> float:
        return foot + (tip - foot) * fraction

    stripes = [(0.0, 0.4, color), (0.4, 0.58, WHITE), (0.58, 0.7, color), (0.7, 0.82, WHITE), (0.82, 1.0, color)]
    rings = [
        cone(0, 0, 0.04 + a * (height - 0.04), 0.04 + b * (height - 0.04), radius(a), radius(b), c)
        for a, b, c in stripes
    ]
    return joined([block((0, 0, 0.025), (0.4, 0.4, 0.05), (30, 30, 32) if name != "short" else color), *rings])


def barrier(name: str) -> Mesh:
    """The mesh of a barrier, about 0.5 m long (its thickness), 2.5 m wide and 1 m high. name: one of BARRIER_NAMES."""
    if name == "concrete":
        return _jersey((172, 168, 160), None)
    if name in ("plastic", "white_plastic"):
        return _jersey(RED if name == "plastic" else WHITE, WHITE if name == "plastic" else RED)
    feet = [block((0, y, 0.05), (0.5, 0.14, 0.1), (46, 46, 48)) for y in (-0.95, 0.95)]
    posts = [block((0, y, 0.5), (0.06, 0.06, 1.0), (150, 152, 150)) for y in (-0.95, 0.95)]
    if name == "plank":
        boards = [
            block((0.04, -1.25 + 0.25 * (k + 0.5), z), (0.04, 0.25, 0.2), RED if k % 2 else WHITE)
            for z in (0.85, 0.45)
            for k in range(10)
        ]
        return joined([*feet, *posts, *boards])
    rails = [block((0, 0, z), (0.05, 2.5, 0.06), (206, 208, 204)) for z in (0.2, 1.02)]
    bars = [block((0, -1.2 + 0.2 * k, 0.6), (0.03, 0.03, 0.84), (206, 208, 204)) for k in range(13)]
    return joined([*feet, *rails, *bars, block((0.03, 0, 0.72), (0.03, 0.9, 0.3), ORANGE)])


def _jersey(color: Color, other: Color | None) -> Mesh:
    """A wall along y with a sloped foot. other: the colour of every second piece; None for one colour."""
    outline = [
        (-0.28, 0.0),
        (0.28, 0.0),
        (0.26, 0.2),
        (0.1, 0.45),
        (0.08, 0.95),
        (-0.08, 0.95),
        (-0.1, 0.45),
        (-0.26, 0.2),
    ]
    count = 1 if other is None else 4
    parts = []
    for k in range(count):
        paint = color if k % 2 == 0 or other is None else other
        y = -1.25 + (2 * k + 1) * 1.25 / count
        parts.append(side_profile(outline, 1.25 / count, paint, y=y))
    return joined(parts)
