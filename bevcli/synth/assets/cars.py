"""Meshes of cars: a body extruded from a side profile, a cabin with windows, wheels and lamps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from bevcli.synth.assets.mesh import Material, Mesh, block, joined, rod, side_profile, wheel
from bevcli.synth.assets.paint import GLASS, PAINT, TRIM


@dataclass(frozen=True)
class CarShape:
    """Proportions of a car.

    Attributes:
        length: metres.
        width: metres.
        height: metres.
        belt: height of the lower edge of the windows, metres.
        nose: height of the bonnet's front edge, metres.
        tail: height of the boot's rear edge, metres.
        cabin: positions along the car as fractions of its length, 0 at the tail and 1 at the nose: rear window's
            lower edge, its upper edge, windscreen's upper edge, its lower edge.
        wheel_radius: metres.
        clearance: height of the body's underside, metres.
    """

    length: float
    width: float
    height: float
    belt: float
    nose: float
    tail: float
    cabin: tuple[float, float, float, float]
    wheel_radius: float = 0.33
    clearance: float = 0.2


CAR_SHAPES: dict[str, CarShape] = {
    "sedan": CarShape(4.7, 1.84, 1.46, 0.92, 0.72, 0.86, (0.10, 0.26, 0.54, 0.72)),
    "hatchback": CarShape(4.1, 1.78, 1.50, 0.92, 0.74, 0.90, (0.02, 0.10, 0.56, 0.76)),
    "suv": CarShape(4.75, 1.94, 1.76, 1.08, 0.94, 1.05, (0.02, 0.10, 0.58, 0.74), 0.38, 0.26),
    "wagon": CarShape(4.75, 1.84, 1.50, 0.92, 0.74, 0.92, (0.02, 0.12, 0.55, 0.72)),
    "minivan": CarShape(4.95, 1.98, 1.80, 1.02, 0.90, 1.00, (0.01, 0.06, 0.64, 0.86)),
    "coupe": CarShape(4.45, 1.86, 1.32, 0.86, 0.66, 0.84, (0.06, 0.32, 0.48, 0.68)),
    "van": CarShape(5.3, 1.98, 2.10, 1.20, 1.06, 1.16, (0.005, 0.02, 0.72, 0.88), 0.35),
    "taxi": CarShape(4.8, 1.86, 1.60, 0.94, 0.76, 0.90, (0.08, 0.22, 0.55, 0.73)),
}


def car(name: str) -> Mesh:
    """The mesh of a car. name: a key of CAR_SHAPES."""
    s = CAR_SHAPES[name]
    half, x = s.width / 2, _along(s)
    body = [
        (x(0.0), s.clearance + 0.14), (x(0.02), s.clearance), (x(0.98), s.clearance), (x(1.0), s.clearance + 0.16),
        (x(0.992), s.nose - 0.12), (x(0.95), s.nose), (x(s.cabin[3]), s.belt), (x(s.cabin[0]), s.belt),
        (x(0.005), s.tail),
    ]  # fmt: skip
    glass = [(x(s.cabin[0]), s.belt), (x(s.cabin[3]), s.belt), (x(s.cabin[2]), s.height), (x(s.cabin[1]), s.height)]
    roof_half = half * 0.76
    parts = [
        side_profile(body, half * 0.97, PAINT, Material.PAINT, top_half_width=half * 0.93),
        side_profile(glass, half * 0.92, GLASS, Material.GLASS, top_half_width=roof_half),
        block((x((s.cabin[1] + s.cabin[2]) / 2), 0, s.height - 0.02),
              (s.length * (s.cabin[2] - s.cabin[1]) + 0.1, roof_half * 2 + 0.04, 0.06), PAINT, Material.PAINT),
        *_pillars(s, half, roof_half), *_details(s, half),
    ]  # fmt: skip
    if name == "taxi":
        parts.append(block((x(0.42), 0, s.height + 0.09), (0.22, 0.6, 0.16), (255, 214, 90), Material.GLOW))
    return joined(parts)


def _along(s: CarShape) -> Callable[[float], float]:
    """A function from a fraction of the length to x in metres."""
    return lambda fraction: (fraction - 0.5) * s.length


def _pillars(s: CarShape, half: float, roof_half: float) -> list[Mesh]:
    """Posts at the cabin's corners and between the doors."""
    x = _along(s)
    posts = []
    middle = (s.cabin[1] + s.cabin[2]) / 2
    for foot, head in ((s.cabin[0], s.cabin[1]), (s.cabin[3], s.cabin[2]), (middle, middle)):
        for side in (-1, 1):
            posts.append(
                rod((x(foot), side * half * 0.915, s.belt), (x(head), side * roof_half, s.height - 0.02), 0.045,
                    PAINT, Material.PAINT, sections=4)
            )  # fmt: skip
    return posts


def _details(s: CarShape, half: float) -> list[Mesh]:
    """Wheels and their arches, lamps, bumpers, number plates and mirrors."""
    x = _along(s)
    lamp_z, tail_z = s.nose - 0.1, s.tail - 0.12
    parts = [
        block((x(0.995), 0, s.clearance + 0.2), (0.06, half * 1.5, 0.16), TRIM),
        block((x(0.99), 0, lamp_z - 0.06), (0.08, half * 0.9, 0.12), TRIM),
        block((x(0.005), 0, s.clearance + 0.2), (0.06, half * 1.6, 0.16), TRIM),
        block((x(0.0), 0, s.clearance + 0.42), (0.04, 0.5, 0.12), (225, 225, 220)),
        block((x(1.0), 0, s.clearance + 0.26), (0.04, 0.5, 0.11), (225, 225, 220)),
    ]
    for side in (-1, 1):
        parts += [
            block((x(0.98), side * half * 0.74, lamp_z), (0.16, half * 0.34, 0.13), (255, 250, 230), Material.GLOW),
            block((x(0.012), side * half * 0.76, tail_z), (0.1, half * 0.3, 0.16), (190, 16, 18), Material.GLOW),
            block((x(s.cabin[3] - 0.04), side * half * 0.95, s.belt + 0.07), (0.14, half * 0.1, 0.12), TRIM),
            block((x(0.5), side * half * 0.955, s.clearance + 0.05), (s.length * 0.5, 0.06, 0.1), TRIM),
        ]
        for fraction in (0.185, 0.81):
            arch = s.wheel_radius + 0.05
            parts += [
                rod((x(fraction), side * half * 0.8, s.wheel_radius + 0.02),
                    (x(fraction), side * half * 0.972, s.wheel_radius + 0.02), arch, (12, 12, 13), sections=12),
                wheel(x(fraction), side * (half - 0.12), s.wheel_radius, 0.22),
            ]  # fmt: skip
    return parts
