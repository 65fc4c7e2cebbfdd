"""Meshes of bicycles and motorcycles, with and without riders."""

from __future__ import annotations

from bevcli.synth.assets.mesh import Material, Mesh, ball, block, joined, rod, side_profile
from bevcli.synth.assets.paint import PAINT, TRIM, Color
from bevcli.synth.assets.people import rider

RUBBER: Color = (24, 24, 26)
CHROME: Color = (176, 178, 182)
BICYCLE_NAMES = ("city", "racer", "cargo", "mountain", "city_rider", "racer_rider", "cargo_rider", "mountain_rider")
MOTORCYCLE_NAMES = ("sport", "cruiser", "scooter", "sport_rider", "cruiser_rider", "scooter_rider")


def _thin_wheel(x: float, radius: float, width: float) -> Mesh:
    """A wheel: a dark tyre around a lighter disc."""
    return joined(
        [
            rod((x, -width / 2, radius), (x, width / 2, radius), radius, RUBBER, sections=14),
            rod(
                (x, -width / 2 - 0.005, radius),
                (x, width / 2 + 0.005, radius),
                radius * 0.86,
                (150, 152, 156),
                sections=14,
            ),
            rod((x, -width / 2 - 0.02, radius), (x, width / 2 + 0.02, radius), radius * 0.15, TRIM, sections=6),
        ]
    )


def bicycle(name: str) -> Mesh:
    """The mesh of a bicycle. name: one of BICYCLE_NAMES; with the suffix "_rider" a person sits on it."""
    kind = name.removesuffix("_rider")
    reach = {"city": 1.05, "racer": 1.0, "cargo": 1.35, "mountain": 1.08}[kind]
    radius, seat_z, bar_z = 0.34, 0.92, {"city": 1.08, "racer": 0.95, "cargo": 1.05, "mountain": 1.02}[kind]
    back, front = -reach / 2, reach / 2
    crank, seat, head = (-0.05, 0, 0.3), (-0.22, 0, seat_z), (front - 0.2, 0, bar_z - 0.12)
    tube = 0.03
    parts = [
        _thin_wheel(back, radius, 0.045),
        _thin_wheel(front, radius, 0.045),
        rod(crank, seat, tube, PAINT, Material.PAINT, 5),
        rod(seat, head, tube, PAINT, Material.PAINT, 5),
        rod(crank, head, tube, PAINT, Material.PAINT, 5),
        rod(crank, (back, 0, radius), 0.025, PAINT, Material.PAINT, 4),
        rod(seat, (back, 0, radius), 0.02, PAINT, Material.PAINT, 4),
        rod((front - 0.22, 0, bar_z), (front, 0, radius), 0.028, TRIM, sections=5),
        rod((front - 0.24, -0.27, bar_z), (front - 0.24, 0.27, bar_z), 0.022, TRIM, sections=5),
        block((-0.24, 0, seat_z + 0.03), (0.26, 0.15, 0.06), RUBBER),
        rod((-0.05, -0.16, 0.3), (-0.05, 0.16, 0.3), 0.03, CHROME, sections=5),
    ]
    if kind == "city":
        parts += [
            block((back - 0.02, 0, 0.74), (0.42, 0.16, 0.03), TRIM),
            block((front - 0.05, 0, 0.98), (0.3, 0.34, 0.22), (120, 92, 62)),
        ]
    if kind == "cargo":
        parts.append(block((0.32, 0, 0.62), (0.55, 0.5, 0.45), (168, 122, 70)))
    if name.endswith("_rider"):
        parts.append(
            rider(
                (-0.24, seat_z + 0.04),
                (front - 0.24, bar_z),
                (-0.05, 0.3),
                (230, 230, 226) if kind == "racer" else (52, 58, 70),
            )
        )
    return joined(parts)


def motorcycle(name: str) -> Mesh:
    """The mesh of a motorcycle. name: one of MOTORCYCLE_NAMES; with the suffix "_rider" a person sits on it."""
    kind = name.removesuffix("_rider")
    radius, reach = (0.24, 1.25) if kind == "scooter" else (0.32, 1.45)
    back, front = -reach / 2, reach / 2
    parts = [rod((x, -0.07, radius), (x, 0.07, radius), radius, RUBBER, sections=14) for x in (back, front)]
    parts += [rod((x, -0.085, radius), (x, 0.085, radius), radius * 0.55, CHROME, sections=8) for x in (back, front)]
    bar_z = 1.08 if kind == "cruiser" else 0.98
    parts += [rod((front - 0.28, y, bar_z), (front, y, radius), 0.035, CHROME, sections=5) for y in (-0.1, 0.1)]
    parts += [
        rod((front - 0.3, -0.36, bar_z), (front - 0.3, 0.36, bar_z), 0.025, TRIM, sections=5),
        ball((front - 0.14, 0, bar_z - 0.16), (0.1, 0.11, 0.11), (255, 248, 226), Material.GLOW),
        block((back - 0.12, 0, 0.72), (0.08, 0.2, 0.1), (190, 16, 18), Material.GLOW),
    ]
    if kind == "scooter":
        parts += [
            side_profile(
                [(back - 0.1, 0.35), (back + 0.6, 0.3), (back + 0.55, 0.75), (back - 0.1, 0.78)],
                0.2,
                PAINT,
                Material.PAINT,
            ),
            side_profile(
                [(front - 0.42, 0.3), (front - 0.3, 0.28), (front - 0.22, 0.95), (front - 0.34, 0.98)],
                0.22,
                PAINT,
                Material.PAINT,
            ),
            block((0.0, 0, 0.3), (0.6, 0.36, 0.08), TRIM),
            block((back + 0.2, 0, 0.8), (0.7, 0.28, 0.08), RUBBER),
        ]
    else:
        tank_z = 0.82 if kind == "sport" else 0.74
        parts += [
            block((-0.02, 0, 0.45), (0.55, 0.3, 0.36), (70, 70, 74)),
            side_profile(
                [(-0.15, 0.62), (0.35, 0.66), (0.38, tank_z), (0.0, tank_z + 0.14), (-0.2, tank_z)],
                0.17,
                PAINT,
                Material.PAINT,
            ),
            block((-0.42, 0, 0.76), (0.62, 0.26, 0.1), RUBBER),
            side_profile(
                [(back - 0.15, 0.66), (back + 0.4, 0.6), (back + 0.4, 0.72), (back - 0.12, 0.82)],
                0.13,
                PAINT,
                Material.PAINT,
            ),
            *[rod((-0.1, y, 0.3), (back - 0.1, y, 0.36), 0.05, CHROME) for y in (-0.17, 0.17)],
        ]
        if kind == "sport":
            parts.append(
                side_profile(
                    [
                        (front - 0.42, 0.6),
                        (front - 0.1, 0.62),
                        (front - 0.12, 0.9),
                        (front - 0.3, 1.08),
                        (front - 0.42, 0.9),
                    ],
                    0.18,
                    PAINT,
                    Material.PAINT,
                )
            )
    if name.endswith("_rider"):
        seat = (back + 0.35, 0.82) if kind == "scooter" else (-0.4, 0.8)
        parts.append(rider(seat, (front - 0.3, bar_z), (0.0, 0.36), (200, 30, 34) if kind == "sport" else (34, 36, 40)))
    return joined(parts)
