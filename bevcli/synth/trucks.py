"""Trucks, buses and trailers."""

from __future__ import annotations

from bevcli.synth.cars import GLASS, PAINT, TRIM
from bevcli.synth.mesh import Material, Mesh, block, joined, rod, side_profile, wheel
from bevcli.synth.palette import Color

CARGO: Color = (224, 224, 220)
LAMP: Color = (255, 248, 226)
TAIL: Color = (190, 16, 18)
TRUCK_NAMES = ("pickup", "delivery", "box", "flatbed", "tanker", "dumper", "garbage", "tractor")
BUS_NAMES = ("city", "coach", "school", "mini", "double", "shuttle", "articulated")
TRAILER_NAMES = ("box", "curtain", "container", "tanker", "flatbed", "utility")


def truck(name: str) -> Mesh:
    """One of TRUCK_NAMES."""
    if name == "pickup":
        return _pickup()
    if name == "delivery":
        return _delivery()
    length, height = {"box": (7.6, 3.3), "flatbed": (8.0, 2.7), "tanker": (8.4, 3.1), "dumper": (7.4, 3.1),
                      "garbage": (8.2, 3.3), "tractor": (6.2, 3.2)}[name]  # fmt: skip
    half, rear = 1.2, -length / 2
    cab = _cab(length / 2, half, min(height, 3.0))
    bed = length - 2.3
    middle = rear + bed / 2
    parts = [
        cab,
        block((middle, 0, 0.85), (bed, 1.0, 0.3), TRIM),
        *_axles((rear + 1.1, rear + 2.4, length / 2 - 1.2), half, 0.5),
    ]
    if name == "box":
        parts += [block((middle, 0, height / 2 + 0.5), (bed, 2 * half, height - 1.0), CARGO, Material.DYE),
                  block((middle, 0, 1.3), (bed + 0.02, 2 * half + 0.02, 0.5), PAINT, Material.PAINT)]  # fmt: skip
    elif name == "flatbed":
        parts += [block((middle, 0, 1.1), (bed, 2 * half, 0.18), (112, 92, 70)),
                  block((middle + 0.6, 0.1, 1.7), (2.2, 1.8, 1.0), (150, 116, 80)),
                  block((middle - 1.6, -0.2, 1.5), (1.5, 1.6, 0.7), (120, 124, 126)),
                  block((rear + bed - 0.06, 0, 1.7), (0.1, 2 * half, 1.1), TRIM)]  # fmt: skip
    elif name == "tanker":
        parts += [rod((rear + 0.1, 0, 2.05), (rear + bed - 0.15, 0, 2.05), 1.05, CARGO, Material.DYE, 12),
                  block((middle, 0, 3.08), (bed * 0.5, 0.5, 0.06), TRIM)]  # fmt: skip
    elif name == "dumper":
        outline = [(rear + 0.15, 1.1), (rear + bed - 0.3, 1.1), (rear + bed - 0.1, height - 0.2), (rear, height - 0.5)]
        parts += [side_profile(outline, half, PAINT, Material.DYE),
                  *[block((x, side * half, 1.9), (0.1, 0.06, 1.4), TRIM) for x in (rear + 1, middle, rear + bed - 1) for side in (-1, 1)]]  # fmt: skip
    elif name == "garbage":
        parts += [side_profile([(rear + 0.9, 1.0), (rear + bed - 0.1, 1.0), (rear + bed - 0.1, height), (rear + 0.9, height)], half, PAINT, Material.DYE),
                  side_profile([(rear, 0.7), (rear + 0.95, 0.7), (rear + 0.95, height - 0.1), (rear + 0.35, height - 0.3)], half * 0.96, (90, 96, 92))]  # fmt: skip
    else:
        parts += [block((rear + 1.6, 0, 1.15), (1.2, 0.9, 0.14), (70, 70, 72)), rod((rear + bed - 0.2, 0.8, 1), (rear + bed - 0.2, 0.8, height), 0.08, (180, 182, 184))]  # fmt: skip
    parts += [block((rear + 0.03, side * half * 0.8, 0.9), (0.08, 0.3, 0.16), TAIL, Material.GLOW) for side in (-1, 1)]
    return joined(parts)


def _pickup() -> Mesh:
    body = [(-2.8, 0.55), (-2.7, 0.35), (2.7, 0.35), (2.8, 0.6), (2.75, 1.05), (1.2, 1.15), (-2.8, 1.1)]
    glass = [(-0.65, 1.12), (1.35, 1.12), (0.75, 1.83), (-0.5, 1.83)]
    parts = [side_profile(body, 0.98, PAINT, Material.PAINT), side_profile(glass, 0.9, GLASS, Material.GLASS, top_half_width=0.76),
             block((0.12, 0, 1.83), (1.35, 1.56, 0.07), PAINT, Material.PAINT), block((-1.75, 0, 1.1), (1.9, 1.6, 0.06), (20, 20, 22)),
             block((-1.8, 0.9, 1.2), (2.0, 0.14, 0.18), PAINT, Material.PAINT), block((-1.8, -0.9, 1.2), (2.0, 0.14, 0.18), PAINT, Material.PAINT),
             block((-2.72, 0, 1.2), (0.12, 1.9, 0.18), PAINT, Material.PAINT), block((2.78, 0, 0.82), (0.08, 1.0, 0.25), TRIM),
             block((2.76, 0, 0.5), (0.1, 1.9, 0.2), TRIM), block((-2.78, 0, 0.5), (0.1, 1.9, 0.18), TRIM)]  # fmt: skip
    for side in (-1, 1):
        parts += [block((2.74, side * 0.78, 0.88), (0.12, 0.3, 0.18), LAMP, Material.GLOW), block((-2.78, side * 0.86, 0.95), (0.06, 0.18, 0.3), TAIL, Material.GLOW),
                  *[rod((a, side * 0.89, 1.12), (b, side * 0.77, 1.82), 0.05, PAINT, Material.PAINT, 4) for a, b in ((-0.6, -0.48), (0.3, 0.2), (1.3, 0.74))]]  # fmt: skip
    return joined([*parts, *_axles((-1.75, 1.85), 1.0, 0.4)])


def _delivery() -> Mesh:
    body = [(-3.1, 0.4), (3.0, 0.4), (3.1, 0.7), (3.0, 1.15), (2.3, 1.35), (1.75, 2.4), (1.3, 2.75), (-3.1, 2.75)]
    shield = [(1.72, 1.45), (2.36, 1.4), (1.83, 2.4), (1.4, 2.5)]
    parts = [side_profile(body, 1.0, PAINT, Material.PAINT, top_half_width=0.95), side_profile(shield, 0.93, GLASS, Material.GLASS, top_half_width=0.9),
             block((1.45, 0, 1.85), (0.8, 1.985, 0.7), GLASS, Material.GLASS), block((-0.9, 0, 1.7), (3.2, 2.0, 0.35), CARGO, Material.DYE),
             block((3.06, 0, 0.6), (0.1, 1.9, 0.25), TRIM), block((-3.08, 0, 0.5), (0.1, 1.9, 0.2), TRIM), block((-3.1, 0, 1.7), (0.04, 0.04, 1.9), TRIM)]  # fmt: skip
    for side in (-1, 1):
        parts += [
            block((3.02, side * 0.75, 0.92), (0.14, 0.34, 0.2), LAMP, Material.GLOW),
            block((-3.1, side * 0.9, 1.3), (0.06, 0.14, 0.5), TAIL, Material.GLOW),
        ]
    return joined([*parts, *_axles((-1.9, 2.05), 1.0, 0.37)])


def _cab(nose: float, half: float, height: float) -> Mesh:
    """A cab-over driver's cab whose front is at x = nose."""
    body = [
        (nose - 2.1, 0.6),
        (nose, 0.45),
        (nose, 1.5),
        (nose - 0.12, height - 0.25),
        (nose - 0.5, height),
        (nose - 2.1, height),
    ]
    parts = [side_profile(body, half * 0.98, PAINT, Material.PAINT, top_half_width=half * 0.94),
             side_profile([(nose - 0.4, 1.55), (nose + 0.015, 1.55), (nose - 0.1, 2.4), (nose - 0.4, 2.4)], half * 0.9, GLASS, Material.GLASS),
             block((nose - 0.95, 0, 1.95), (0.9, half * 1.955, 0.75), GLASS, Material.GLASS),
             block((nose, 0, 1.15), (0.05, half * 1.2, 0.4), TRIM), block((nose - 0.03, 0, 0.6), (0.12, half * 1.96, 0.3), TRIM)]  # fmt: skip
    for side in (-1, 1):
        parts += [block((nose, side * half * 0.78, 0.8), (0.06, 0.34, 0.18), LAMP, Material.GLOW),
                  block((nose - 0.15, side * (half - 0.05), 2.0), (0.12, 0.1, 0.5), TRIM)]  # fmt: skip
    return joined(parts)


def _axles(positions: tuple[float, ...], half: float, radius: float) -> list[Mesh]:
    return [wheel(x, side * (half - 0.16), radius, 0.3) for x in positions for side in (-1, 1)]


def bus(name: str) -> Mesh:
    """One of BUS_NAMES."""
    length, height, floor = {"city": (12.0, 3.1, 0.35), "coach": (12.4, 3.6, 0.5), "school": (10.4, 3.1, 0.6), "mini": (7.2, 2.8, 0.35),
                             "double": (10.8, 4.2, 0.35), "shuttle": (8.6, 3.0, 0.35), "articulated": (15.5, 3.1, 0.35)}[name]  # fmt: skip
    half, front = 1.28, length / 2
    slope = 0.5 if name == "coach" else 0.12
    nose = front - 1.5 if name == "school" else front
    body = [
        (-front, floor),
        (nose, floor),
        (nose, 1.3),
        (nose - slope, height - 0.1),
        (nose - slope - 0.15, height),
        (-front + 0.1, height),
    ]
    parts = [side_profile(body, half, PAINT, Material.PAINT, top_half_width=half * 0.96)]
    decks = [(1.35, 2.35)] if name != "double" else [(1.2, 1.95), (2.65, 3.5)]
    if name == "coach":
        decks = [(1.9, 3.0)]
    for low, high in decks:
        parts += _bus_windows(-front + 0.7, nose - 1.0, low, high, half)
        parts.append(
            block(
                (nose - slope / 2, 0, (low + high) / 2 + 0.05),
                (0.06 + slope * 0.5, half * 1.8, high - low + 0.25),
                GLASS,
                Material.GLASS,
            )
        )
        parts.append(block((-front + 0.02, 0, (low + high) / 2), (0.08, half * 1.5, high - low), GLASS, Material.GLASS))
    if name == "school":
        parts += [
            block((front - 0.75, 0, 1.05), (1.5, half * 1.7, 1.1), PAINT, Material.PAINT),
            block((front, 0, 0.95), (0.05, 1.3, 0.6), TRIM),
        ]
    if name == "articulated":
        parts.append(block((-1.5, 0, height / 2 + 0.15), (0.8, half * 1.99, height - 0.5), (40, 40, 42)))
    if name in ("city", "articulated", "double", "mini", "shuttle"):
        parts += [block((nose - 0.05, 0, min(height - 0.25, 2.75)), (0.12, 1.7, 0.28), (255, 170, 40), Material.GLOW),
                  *[block((x, -half + 0.01, 1.4), (1.1, 0.05, 2.0), GLASS, Material.GLASS) for x in (nose - 1.0, 0.0)]]  # fmt: skip
    parts.append(block((0, 0, floor + 0.35), (length * 0.92, half * 2.01, 0.22), CARGO, Material.DYE))
    for side in (-1, 1):
        parts += [block((front - 0.02, side * half * 0.75, 0.75), (0.08, 0.4, 0.2), LAMP, Material.GLOW),
                  block((-front, side * half * 0.82, 1.0), (0.06, 0.22, 0.4), TAIL, Material.GLOW)]  # fmt: skip
    axles = (-front * 0.55, front * 0.58) if name != "articulated" else (-front * 0.6, -0.2, front * 0.65)
    return joined([*parts, *_axles(axles, half + 0.02, 0.46)])


def _bus_windows(start: float, end: float, low: float, high: float, half: float) -> list[Mesh]:
    count = max(int((end - start) / 1.4), 2)
    width = (end - start) / count
    return [
        block(
            (start + (k + 0.5) * width, 0, (low + high) / 2),
            (width - 0.14, half * 1.985, high - low),
            GLASS,
            Material.GLASS,
        )
        for k in range(count)
    ]


def trailer(name: str) -> Mesh:
    """One of TRAILER_NAMES; its drawbar or kingpin is at the front."""
    if name == "utility":
        return _utility_trailer()
    length, half, height = (
        12.4,
        1.27,
        {"box": 3.9, "curtain": 3.9, "container": 3.8, "tanker": 3.5, "flatbed": 2.6}[name],
    )
    rear = -length / 2
    parts = [block((0, 0, 1.1), (length, 1.0, 0.28), TRIM), block((length / 2 - 2.6, 0, 0.6), (0.2, 1.4, 0.9), TRIM),
             block((rear + 0.08, 0, 0.6), (0.12, 2.3, 0.2), TRIM), *_axles((rear + 1.2, rear + 2.5, rear + 3.8), half, 0.5)]  # fmt: skip
    if name in ("box", "container", "curtain"):
        parts.append(block((0, 0, height / 2 + 0.62), (length, 2 * half, height - 1.24), CARGO, Material.DYE))
        ribs = int(length / 0.8) if name == "container" else 4
        parts += [
            block(
                (rear + (k + 0.5) * length / ribs, 0, height / 2 + 0.62),
                (0.1, 2 * half + 0.05, height - 1.3),
                PAINT,
                Material.PAINT,
            )
            for k in range(ribs)
        ]
        parts.append(block((rear, 0, height / 2 + 0.6), (0.05, 0.06, height - 1.4), TRIM))
        if name == "curtain":
            parts.append(block((0, 0, height - 1.1), (length * 0.5, 2 * half + 0.03, 0.8), PAINT, Material.PAINT))
    elif name == "tanker":
        parts += [rod((rear + 0.05, 0, 2.35), (length / 2 - 0.05, 0, 2.35), 1.1, (198, 200, 202), Material.PAINT, 12),
                  block((0, 0, 3.45), (length * 0.7, 0.5, 0.08), TRIM)]  # fmt: skip
    else:
        parts += [block((0, 0, 1.3), (length, 2 * half, 0.16), (120, 98, 74)), block((length / 2 - 0.06, 0, 1.9), (0.12, 2 * half, 1.3), PAINT, Material.PAINT),
                  *[rod((rear + 1.2, y, 1.75), (length / 2 - 1.5, y, 1.75), 0.38, (128, 104, 84), sections=8) for y in (-0.8, 0, 0.8)],
                  *[rod((rear + 1.2, y, 2.35), (length / 2 - 1.5, y, 2.35), 0.36, (138, 112, 90), sections=8) for y in (-0.4, 0.4)]]  # fmt: skip
    parts += [block((rear - 0.01, side * half * 0.8, 1.1), (0.06, 0.3, 0.16), TAIL, Material.GLOW) for side in (-1, 1)]
    return joined(parts)


def _utility_trailer() -> Mesh:
    return joined([
        block((-0.5, 0, 0.75), (3.6, 1.9, 0.12), (96, 92, 86)), *[block((-0.5, y, 1.05), (3.6, 0.06, 0.6), PAINT, Material.PAINT) for y in (-0.93, 0.93)],
        block((-2.28, 0, 1.05), (0.06, 1.9, 0.6), PAINT, Material.PAINT), block((1.28, 0, 1.05), (0.06, 1.9, 0.6), PAINT, Material.PAINT),
        rod((1.2, 0, 0.6), (2.4, 0, 0.5), 0.06, TRIM), block((-0.4, 0.1, 1.3), (2.2, 1.3, 0.7), (140, 110, 78)), *_axles((-0.7,), 1.08, 0.34),
        *[block((-2.3, y, 0.7), (0.06, 0.2, 0.12), TAIL, Material.GLOW) for y in (-0.8, 0.8)],
    ])  # fmt: skip
