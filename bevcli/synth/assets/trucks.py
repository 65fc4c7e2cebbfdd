"""Meshes of trucks."""

from __future__ import annotations

from bevcli.synth.assets.mesh import Material, Mesh, block, joined, rod, side_profile, wheel
from bevcli.synth.assets.paint import CARGO, GLASS, HEADLAMP, PAINT, TAIL_LAMP, TRIM

TRUCK_NAMES = ("pickup", "delivery", "box", "flatbed", "tanker", "dumper", "garbage", "tractor")


def truck(name: str) -> Mesh:
    """The mesh of a truck. name: one of TRUCK_NAMES."""
    if name == "pickup":
        return _pickup()
    if name == "delivery":
        return _delivery()
    length, height = {
        "box": (7.6, 3.3),
        "flatbed": (8.0, 2.7),
        "tanker": (8.4, 3.1),
        "dumper": (7.4, 3.1),
        "garbage": (8.2, 3.3),
        "tractor": (6.2, 3.2),
    }[name]
    half, rear = 1.2, -length / 2
    cab = _cab(length / 2, half, min(height, 3.0))
    bed = length - 2.3
    middle = rear + bed / 2
    parts = [
        cab,
        block((middle, 0, 0.85), (bed, 1.0, 0.3), TRIM),
        *axles((rear + 1.1, rear + 2.4, length / 2 - 1.2), half, 0.5),
    ]
    if name == "box":
        parts += [
            block((middle, 0, height / 2 + 0.5), (bed, 2 * half, height - 1.0), CARGO, Material.DYE),
            block((middle, 0, 1.3), (bed + 0.02, 2 * half + 0.02, 0.5), PAINT, Material.PAINT),
        ]
    elif name == "flatbed":
        parts += [
            block((middle, 0, 1.1), (bed, 2 * half, 0.18), (112, 92, 70)),
            block((middle + 0.6, 0.1, 1.7), (2.2, 1.8, 1.0), (150, 116, 80)),
            block((middle - 1.6, -0.2, 1.5), (1.5, 1.6, 0.7), (120, 124, 126)),
            block((rear + bed - 0.06, 0, 1.7), (0.1, 2 * half, 1.1), TRIM),
        ]
    elif name == "tanker":
        parts += [
            rod((rear + 0.1, 0, 2.05), (rear + bed - 0.15, 0, 2.05), 1.05, CARGO, Material.DYE, 12),
            block((middle, 0, 3.08), (bed * 0.5, 0.5, 0.06), TRIM),
        ]
    elif name == "dumper":
        outline = [(rear + 0.15, 1.1), (rear + bed - 0.3, 1.1), (rear + bed - 0.1, height - 0.2), (rear, height - 0.5)]
        parts += [
            side_profile(outline, half, PAINT, Material.DYE),
            *[
                block((x, side * half, 1.9), (0.1, 0.06, 1.4), TRIM)
                for x in (rear + 1, middle, rear + bed - 1)
                for side in (-1, 1)
            ],
        ]
    elif name == "garbage":
        parts += [
            side_profile(
                [(rear + 0.9, 1.0), (rear + bed - 0.1, 1.0), (rear + bed - 0.1, height), (rear + 0.9, height)],
                half,
                PAINT,
                Material.DYE,
            ),
            side_profile(
                [(rear, 0.7), (rear + 0.95, 0.7), (rear + 0.95, height - 0.1), (rear + 0.35, height - 0.3)],
                half * 0.96,
                (90, 96, 92),
            ),
        ]
    else:
        parts += [
            block((rear + 1.6, 0, 1.15), (1.2, 0.9, 0.14), (70, 70, 72)),
            rod((rear + bed - 0.2, 0.8, 1), (rear + bed - 0.2, 0.8, height), 0.08, (180, 182, 184)),
        ]
    parts += [
        block((rear + 0.03, side * half * 0.8, 0.9), (0.08, 0.3, 0.16), TAIL_LAMP, Material.GLOW) for side in (-1, 1)
    ]
    return joined(parts)


def _pickup() -> Mesh:
    body = [(-2.8, 0.55), (-2.7, 0.35), (2.7, 0.35), (2.8, 0.6), (2.75, 1.05), (1.2, 1.15), (-2.8, 1.1)]
    glass = [(-0.65, 1.12), (1.35, 1.12), (0.75, 1.83), (-0.5, 1.83)]
    parts = [
        side_profile(body, 0.98, PAINT, Material.PAINT),
        side_profile(glass, 0.9, GLASS, Material.GLASS, top_half_width=0.76),
        block((0.12, 0, 1.83), (1.35, 1.56, 0.07), PAINT, Material.PAINT),
        block((-1.75, 0, 1.1), (1.9, 1.6, 0.06), (20, 20, 22)),
        block((-1.8, 0.9, 1.2), (2.0, 0.14, 0.18), PAINT, Material.PAINT),
        block((-1.8, -0.9, 1.2), (2.0, 0.14, 0.18), PAINT, Material.PAINT),
        block((-2.72, 0, 1.2), (0.12, 1.9, 0.18), PAINT, Material.PAINT),
        block((2.78, 0, 0.82), (0.08, 1.0, 0.25), TRIM),
        block((2.76, 0, 0.5), (0.1, 1.9, 0.2), TRIM),
        block((-2.78, 0, 0.5), (0.1, 1.9, 0.18), TRIM),
    ]
    for side in (-1, 1):
        parts += [
            block((2.74, side * 0.78, 0.88), (0.12, 0.3, 0.18), HEADLAMP, Material.GLOW),
            block((-2.78, side * 0.86, 0.95), (0.06, 0.18, 0.3), TAIL_LAMP, Material.GLOW),
            *[
                rod((a, side * 0.89, 1.12), (b, side * 0.77, 1.82), 0.05, PAINT, Material.PAINT, 4)
                for a, b in ((-0.6, -0.48), (0.3, 0.2), (1.3, 0.74))
            ],
        ]
    return joined([*parts, *axles((-1.75, 1.85), 1.0, 0.4)])


def _delivery() -> Mesh:
    body = [(-3.1, 0.4), (3.0, 0.4), (3.1, 0.7), (3.0, 1.15), (2.3, 1.35), (1.75, 2.4), (1.3, 2.75), (-3.1, 2.75)]
    shield = [(1.72, 1.45), (2.36, 1.4), (1.83, 2.4), (1.4, 2.5)]
    parts = [
        side_profile(body, 1.0, PAINT, Material.PAINT, top_half_width=0.95),
        side_profile(shield, 0.93, GLASS, Material.GLASS, top_half_width=0.9),
        block((1.45, 0, 1.85), (0.8, 1.985, 0.7), GLASS, Material.GLASS),
        block((-0.9, 0, 1.7), (3.2, 2.0, 0.35), CARGO, Material.DYE),
        block((3.06, 0, 0.6), (0.1, 1.9, 0.25), TRIM),
        block((-3.08, 0, 0.5), (0.1, 1.9, 0.2), TRIM),
        block((-3.1, 0, 1.7), (0.04, 0.04, 1.9), TRIM),
    ]
    for side in (-1, 1):
        parts += [
            block((3.02, side * 0.75, 0.92), (0.14, 0.34, 0.2), HEADLAMP, Material.GLOW),
            block((-3.1, side * 0.9, 1.3), (0.06, 0.14, 0.5), TAIL_LAMP, Material.GLOW),
        ]
    return joined([*parts, *axles((-1.9, 2.05), 1.0, 0.37)])


def _cab(nose: float, half: float, height: float) -> Mesh:
    """A driver's cab whose front is at x = nose."""
    body = [
        (nose - 2.1, 0.6),
        (nose, 0.45),
        (nose, 1.5),
        (nose - 0.12, height - 0.25),
        (nose - 0.5, height),
        (nose - 2.1, height),
    ]
    parts = [
        side_profile(body, half * 0.98, PAINT, Material.PAINT, top_half_width=half * 0.94),
        side_profile(
            [(nose - 0.4, 1.55), (nose + 0.015, 1.55), (nose - 0.1, 2.4), (nose - 0.4, 2.4)],
            half * 0.9,
            GLASS,
            Material.GLASS,
        ),
        block((nose - 0.95, 0, 1.95), (0.9, half * 1.955, 0.75), GLASS, Material.GLASS),
        block((nose, 0, 1.15), (0.05, half * 1.2, 0.4), TRIM),
        block((nose - 0.03, 0, 0.6), (0.12, half * 1.96, 0.3), TRIM),
    ]
    for side in (-1, 1):
        parts += [
            block((nose, side * half * 0.78, 0.8), (0.06, 0.34, 0.18), HEADLAMP, Material.GLOW),
            block((nose - 0.15, side * (half - 0.05), 2.0), (0.12, 0.1, 0.5), TRIM),
        ]
    return joined(parts)


def axles(positions: tuple[float, ...], half: float, radius: float) -> list[Mesh]:
    """Two wheels at each position along x (metres). half: half the vehicle's width; radius of the wheels; metres."""
    return [wheel(x, side * (half - 0.16), radius, 0.3) for x in positions for side in (-1, 1)]
