"""Meshes of trailers."""

from __future__ import annotations

from bevcli.synth.assets.mesh import Material, Mesh, block, joined, rod
from bevcli.synth.assets.paint import CARGO, PAINT, TAIL_LAMP, TRIM
from bevcli.synth.assets.trucks import axles

TRAILER_NAMES = ("box", "curtain", "container", "tanker", "flatbed", "utility")


def trailer(name: str) -> Mesh:
    """The mesh of a trailer. name: one of TRAILER_NAMES."""
    if name == "utility":
        return _utility_trailer()
    length, half, height = (
        12.4,
        1.27,
        {"box": 3.9, "curtain": 3.9, "container": 3.8, "tanker": 3.5, "flatbed": 2.6}[name],
    )
    rear = -length / 2
    parts = [
        block((0, 0, 1.1), (length, 1.0, 0.28), TRIM),
        block((length / 2 - 2.6, 0, 0.6), (0.2, 1.4, 0.9), TRIM),
        block((rear + 0.08, 0, 0.6), (0.12, 2.3, 0.2), TRIM),
        *axles((rear + 1.2, rear + 2.5, rear + 3.8), half, 0.5),
    ]
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
        parts += [
            rod((rear + 0.05, 0, 2.35), (length / 2 - 0.05, 0, 2.35), 1.1, (198, 200, 202), Material.PAINT, 12),
            block((0, 0, 3.45), (length * 0.7, 0.5, 0.08), TRIM),
        ]
    else:
        parts += [
            block((0, 0, 1.3), (length, 2 * half, 0.16), (120, 98, 74)),
            block((length / 2 - 0.06, 0, 1.9), (0.12, 2 * half, 1.3), PAINT, Material.PAINT),
            *[
                rod((rear + 1.2, y, 1.75), (length / 2 - 1.5, y, 1.75), 0.38, (128, 104, 84), sections=8)
                for y in (-0.8, 0, 0.8)
            ],
            *[
                rod((rear + 1.2, y, 2.35), (length / 2 - 1.5, y, 2.35), 0.36, (138, 112, 90), sections=8)
                for y in (-0.4, 0.4)
            ],
        ]
    parts += [
        block((rear - 0.01, side * half * 0.8, 1.1), (0.06, 0.3, 0.16), TAIL_LAMP, Material.GLOW) for side in (-1, 1)
    ]
    return joined(parts)


def _utility_trailer() -> Mesh:
    return joined(
        [
            block((-0.5, 0, 0.75), (3.6, 1.9, 0.12), (96, 92, 86)),
            *[block((-0.5, y, 1.05), (3.6, 0.06, 0.6), PAINT, Material.PAINT) for y in (-0.93, 0.93)],
            block((-2.28, 0, 1.05), (0.06, 1.9, 0.6), PAINT, Material.PAINT),
            block((1.28, 0, 1.05), (0.06, 1.9, 0.6), PAINT, Material.PAINT),
            rod((1.2, 0, 0.6), (2.4, 0, 0.5), 0.06, TRIM),
            block((-0.4, 0.1, 1.3), (2.2, 1.3, 0.7), (140, 110, 78)),
            *axles((-0.7,), 1.08, 0.34),
            *[block((-2.3, y, 0.7), (0.06, 0.2, 0.12), TAIL_LAMP, Material.GLOW) for y in (-0.8, 0.8)],
        ]
    )
