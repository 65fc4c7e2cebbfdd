"""Meshes of construction vehicles."""

from __future__ import annotations

from collections.abc import Callable

from bevcli.synth.assets.mesh import Material, Mesh, block, joined, rod, side_profile, wheel
from bevcli.synth.assets.paint import GLASS, PAINT, TRIM

WORN_STEEL = (96, 96, 98)
BLACK_RUBBER = (30, 30, 32)


def _cabin(x: float, y: float, bottom: float, size: tuple[float, float, float]) -> list[Mesh]:
    """A cabin with windows, a roof and four posts."""
    length, width, height = size
    parts = [
        block((x, y, bottom + height * 0.15), (length, width, height * 0.3), PAINT, Material.PAINT),
        block((x, y, bottom + height * 0.62), (length * 0.94, width * 0.94, height * 0.66), GLASS, Material.GLASS),
        block((x, y, bottom + height), (length * 1.06, width * 1.06, 0.1), PAINT, Material.PAINT),
    ]
    for sx in (-0.5, 0.5):
        for sy in (-0.5, 0.5):
            foot, head = (x + sx * length, y + sy * width, bottom), (x + sx * length, y + sy * width, bottom + height)
            parts.append(rod(foot, head, 0.05, TRIM, sections=4))
    return parts


def _track(y: float, length: float, height: float, width: float) -> list[Mesh]:
    """A crawler track with its rollers."""
    half = length / 2
    outline = [
        (-half + height / 2, 0),
        (half - height / 2, 0),
        (half, height * 0.5),
        (half - height * 0.35, height),
        (-half + height * 0.35, height),
        (-half, height * 0.5),
    ]
    rollers = [
        rod(
            (x, y - width / 2 - 0.02, height * 0.45),
            (x, y + width / 2 + 0.02, height * 0.45),
            height * 0.3,
            WORN_STEEL,
            sections=8,
        )
        for x in (-half * 0.7, -half * 0.25, half * 0.25, half * 0.7)
    ]
    return [side_profile(outline, width / 2, BLACK_RUBBER, y=y), *rollers]


def _excavator() -> Mesh:
    return joined(
        [
            *_track(1.05, 3.6, 0.85, 0.5),
            *_track(-1.05, 3.6, 0.85, 0.5),
            block((0, 0, 0.75), (2.0, 1.6, 0.4), TRIM),
            block((-0.9, 0, 1.5), (2.2, 2.5, 1.1), PAINT, Material.PAINT),
            block((-1.9, 0, 1.5), (0.5, 2.4, 1.0), TRIM),
            *_cabin(0.6, 0.7, 1.0, (1.4, 1.0, 1.9)),
            rod((0.6, -0.3, 1.5), (2.6, -0.3, 3.3), 0.2, PAINT, Material.PAINT, 6),
            rod((2.6, -0.3, 3.3), (3.9, -0.3, 1.6), 0.16, PAINT, Material.PAINT, 6),
            rod((0.9, -0.3, 2.3), (2.1, -0.3, 3.1), 0.08, (200, 200, 202)),
            side_profile([(3.6, 1.6), (4.2, 1.5), (3.9, 0.6), (3.2, 0.5), (3.2, 0.9)], 0.5, WORN_STEEL, y=-0.3),
        ]
    )


def _loader() -> Mesh:
    return joined(
        [
            block((-1.7, 0, 1.5), (2.0, 1.9, 1.1), PAINT, Material.PAINT),
            block((0.6, 0, 1.1), (2.4, 1.2, 0.6), PAINT, Material.PAINT),
            block((-2.7, 0, 1.3), (0.2, 2.0, 0.8), TRIM),
            *_cabin(-0.3, 0, 1.5, (1.3, 1.4, 1.7)),
            *[wheel(x, y, 0.75, 0.55, (220, 190, 60)) for x in (-1.7, 1.4) for y in (-1.0, 1.0)],
            *[rod((0.6, y, 1.6), (2.7, y, 0.7), 0.11, PAINT, Material.PAINT) for y in (-0.6, 0.6)],
            side_profile([(2.6, 0.15), (3.6, 0.1), (3.5, 0.3), (2.9, 1.1), (2.6, 1.1)], 1.35, WORN_STEEL),
        ]
    )


def _backhoe() -> Mesh:
    return joined(
        [
            block((0.9, 0, 1.2), (2.0, 1.0, 0.7), PAINT, Material.PAINT),
            *_cabin(-0.6, 0, 0.9, (1.5, 1.6, 1.9)),
            *[wheel(-1.1, y, 0.72, 0.5, (220, 190, 60)) for y in (-0.9, 0.9)],
            *[wheel(1.4, y, 0.48, 0.35, (220, 190, 60)) for y in (-0.85, 0.85)],
            *[rod((0.9, y, 1.3), (2.5, y, 0.6), 0.09, PAINT, Material.PAINT) for y in (-0.6, 0.6)],
            side_profile([(2.4, 0.1), (3.2, 0.1), (3.1, 0.3), (2.6, 0.9), (2.4, 0.9)], 1.15, WORN_STEEL),
            rod((-1.6, 0, 1.0), (-2.7, 0, 3.1), 0.14, PAINT, Material.PAINT),
            rod((-2.7, 0, 3.1), (-3.3, 0, 1.5), 0.11, PAINT, Material.PAINT),
            side_profile([(-3.6, 1.0), (-3.0, 1.1), (-2.9, 1.6), (-3.4, 1.6)], 0.35, WORN_STEEL),
            block((-1.7, 0, 0.7), (0.3, 2.1, 0.6), TRIM),
        ]
    )


def _bulldozer() -> Mesh:
    return joined(
        [
            *_track(0.95, 3.4, 1.0, 0.55),
            *_track(-0.95, 3.4, 1.0, 0.55),
            block((0.9, 0, 1.35), (1.9, 1.2, 0.9), PAINT, Material.PAINT),
            block((-0.7, 0, 1.2), (1.6, 1.4, 0.7), PAINT, Material.PAINT),
            *_cabin(-0.6, 0, 1.4, (1.3, 1.4, 1.6)),
            rod((1.2, 0.35, 1.7), (1.2, 0.35, 2.5), 0.07, BLACK_RUBBER),
            side_profile([(2.2, 0.05), (2.45, 0.05), (2.35, 0.7), (2.5, 1.3), (2.2, 1.25)], 1.55, WORN_STEEL),
            *[rod((0.2, y, 0.6), (2.25, y, 0.5), 0.1, PAINT, Material.PAINT) for y in (-1.35, 1.35)],
        ]
    )


def _roller() -> Mesh:
    return joined(
        [
            rod((1.7, -1.0, 0.72), (1.7, 1.0, 0.72), 0.72, WORN_STEEL, sections=14),
            *[block((1.5, y, 0.85), (1.9, 0.1, 0.25), PAINT, Material.PAINT) for y in (-1.06, 1.06)],
            block((-1.3, 0, 1.3), (2.0, 1.5, 0.8), PAINT, Material.PAINT),
            *_cabin(0.1, 0, 1.0, (1.2, 1.4, 1.9)),
            *[wheel(-1.4, y, 0.7, 0.5) for y in (-0.85, 0.85)],
        ]
    )


def _crane() -> Mesh:
    return joined(
        [
            block((0, 0, 0.95), (8.2, 2.4, 0.6), PAINT, Material.PAINT),
            *_cabin(3.2, 0.4, 1.2, (1.5, 1.4, 1.3)),
            *[wheel(x, y, 0.6, 0.4) for x in (-3.0, -1.6, 1.4, 2.8) for y in (-1.05, 1.05)],
            block((-1.2, 0, 1.8), (3.0, 2.0, 1.0), PAINT, Material.PAINT),
            *_cabin(-0.4, -0.6, 1.6, (1.3, 0.9, 1.5)),
            rod((-2.2, 0.2, 2.4), (4.6, 0.2, 3.5), 0.34, PAINT, Material.PAINT, 4),
            rod((3.8, 0.2, 3.36), (5.0, 0.2, 3.56), 0.22, WORN_STEEL, sections=4),
            block((-2.9, 0, 1.8), (0.7, 2.3, 1.0), TRIM),
        ]
    )


def _mixer() -> Mesh:
    drum = side_profile(
        [(-3.6, 1.6), (-2.0, 1.25), (0.6, 1.35), (1.2, 1.9), (0.9, 2.9), (-1.0, 3.2), (-3.4, 2.6)],
        0.95,
        (224, 224, 220),
        Material.DYE,
    )
    return joined(
        [
            drum,
            block((-0.6, 0, 0.95), (7.6, 1.0, 0.3), TRIM),
            *_cabin(3.1, 0, 0.9, (1.7, 2.3, 1.9)),
            block((3.1, 0, 0.8), (2.0, 2.4, 0.7), PAINT, Material.PAINT),
            *[wheel(x, y, 0.5, 0.35) for x in (-2.6, -1.3, 2.8) for y in (-1.05, 1.05)],
            rod((-3.6, 0, 2.9), (-4.3, 0, 1.6), 0.2, PAINT, Material.PAINT),
            *[rod((-3.2, y, 1.0), (-3.4, y * 0.3, 2.8), 0.07, PAINT, Material.PAINT) for y in (-0.8, 0.8)],
        ]
    )


_MACHINES: dict[str, Callable[[], Mesh]] = {
    "excavator": _excavator,
    "loader": _loader,
    "backhoe": _backhoe,
    "bulldozer": _bulldozer,
    "roller": _roller,
    "crane": _crane,
    "mixer": _mixer,
}
MACHINE_NAMES = tuple(_MACHINES)


def machine(name: str) -> Mesh:
    """The mesh of a construction vehicle. name: one of MACHINE_NAMES."""
    return _MACHINES[name]()
