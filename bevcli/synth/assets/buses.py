"""Meshes of buses."""

from __future__ import annotations

from bevcli.synth.assets.mesh import Material, Mesh, block, joined, side_profile
from bevcli.synth.assets.paint import CARGO, GLASS, HEADLAMP, PAINT, TAIL_LAMP, TRIM
from bevcli.synth.assets.trucks import axles

BUS_NAMES = ("city", "coach", "school", "mini", "double", "shuttle", "articulated")


def bus(name: str) -> Mesh:
    """The mesh of a bus. name: one of BUS_NAMES."""
    length, height, floor = {
        "city": (12.0, 3.1, 0.35),
        "coach": (12.4, 3.6, 0.5),
        "school": (10.4, 3.1, 0.6),
        "mini": (7.2, 2.8, 0.35),
        "double": (10.8, 4.2, 0.35),
        "shuttle": (8.6, 3.0, 0.35),
        "articulated": (15.5, 3.1, 0.35),
    }[name]
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
        parts += [
            block((nose - 0.05, 0, min(height - 0.25, 2.75)), (0.12, 1.7, 0.28), (255, 170, 40), Material.GLOW),
            *[block((x, -half + 0.01, 1.4), (1.1, 0.05, 2.0), GLASS, Material.GLASS) for x in (nose - 1.0, 0.0)],
        ]
    parts.append(block((0, 0, floor + 0.35), (length * 0.92, half * 2.01, 0.22), CARGO, Material.DYE))
    for side in (-1, 1):
        parts += [
            block((front - 0.02, side * half * 0.75, 0.75), (0.08, 0.4, 0.2), HEADLAMP, Material.GLOW),
            block((-front, side * half * 0.82, 1.0), (0.06, 0.22, 0.4), TAIL_LAMP, Material.GLOW),
        ]
    places = (-front * 0.55, front * 0.58) if name != "articulated" else (-front * 0.6, -0.2, front * 0.65)
    return joined([*parts, *axles(places, half + 0.02, 0.46)])


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
