"""Meshes of people: walking in two mirrored strides, standing, and riding a cycle."""

from __future__ import annotations

import numpy as np

from bevcli.synth.assets.mesh import Material, Mesh, ball, block, cone, joined, loft, rod
from bevcli.synth.assets.paint import Color

SKIN: tuple[Color, ...] = ((224, 176, 146), (196, 144, 112), (142, 96, 70), (98, 66, 50))
HAIR: tuple[Color, ...] = ((40, 32, 28), (92, 66, 42), (180, 146, 90), (120, 118, 116))
SHIRT: Color = (120, 120, 120)
TROUSERS: tuple[Color, ...] = ((44, 52, 76), (52, 50, 50), (112, 98, 78), (78, 84, 92))
PERSON_NAMES = ("man", "woman", "worker", "child", "backpack", "coat")


def person(name: str, stride: int) -> Mesh:
    """The mesh of a person, about 1.75 m tall.

    name: one of PERSON_NAMES. stride: +1 left leg in front, -1 right leg in front, 0 standing.
    """
    k = PERSON_NAMES.index(name)
    skin, hair, legs = SKIN[k % 4], HAIR[(k + 1) % 4], TROUSERS[k % 4]
    swing = 0.26 * stride
    parts = [
        *_leg(0.1, swing, legs),
        *_leg(-0.1, -swing, legs),
        _torso(
            0.86,
            1.46,
            Material.DYE if name != "worker" else Material.MATTE,
            (240, 120, 30) if name == "worker" else SHIRT,
        ),
        *_arm(0.25, -swing * 0.9, skin),
        *_arm(-0.25, swing * 0.9, skin),
        *_head(0.02, 1.62, skin, hair),
    ]
    if name == "woman":
        parts += [
            cone(0, 0, 0.55, 1.0, 0.27, 0.17, SHIRT, Material.DYE),
            ball((-0.07, 0, 1.58), (0.1, 0.13, 0.18), hair),
        ]
    elif name == "worker":
        parts += [
            ball((0.02, 0, 1.73), (0.15, 0.14, 0.09), (250, 210, 40)),
            block((0, 0, 1.2), (0.31, 0.43, 0.06), (236, 240, 200)),
        ]
    elif name == "backpack":
        parts.append(block((-0.2, 0, 1.22), (0.18, 0.32, 0.46), (150, 52, 44)))
    elif name == "coat":
        parts.append(cone(0, 0, 0.5, 1.3, 0.26, 0.2, SHIRT, Material.DYE))
    return joined(parts)


def _leg(y: float, swing: float, color: Color) -> list[Mesh]:
    knee = (swing * 0.6 + 0.03, y, 0.46)
    foot = (swing - 0.03, y, 0.08)
    return [
        rod((0, y, 0.9), knee, 0.085, color),
        rod(knee, foot, 0.065, color),
        block((foot[0] + 0.06, y, 0.05), (0.26, 0.1, 0.1), (36, 32, 30)),
    ]


def _arm(y: float, swing: float, skin: Color) -> list[Mesh]:
    elbow, hand = (swing * 0.5 - 0.02, y * 1.04, 1.14), (swing + 0.04, y, 0.9)
    return [
        rod((0, y * 0.92, 1.4), elbow, 0.06, SHIRT, Material.DYE),
        rod(elbow, hand, 0.048, SHIRT, Material.DYE),
        ball(hand, (0.05, 0.05, 0.06), skin, subdivisions=0),
    ]


def _torso(low: float, high: float, material: Material, color: Color) -> Mesh:
    angle = np.linspace(0, 2 * np.pi, 8, endpoint=False) + np.pi / 8
    ring = np.stack([0.13 * np.cos(angle), 0.2 * np.sin(angle)], -1)
    levels = ((low, 0.86), ((low + high) / 2, 0.9), (high - 0.08, 1.12), (high, 0.75))
    return loft([np.column_stack([ring * scale, np.full(8, z)]) for z, scale in levels], color, material)


def _head(x: float, z: float, skin: Color, hair: Color) -> list[Mesh]:
    return [
        rod((x - 0.02, 0, z - 0.2), (x, 0, z - 0.05), 0.055, skin),
        ball((x, 0, z), (0.105, 0.085, 0.125), skin),
        ball((x - 0.025, 0, z + 0.035), (0.105, 0.095, 0.105), hair),
    ]


def rider(seat: tuple[float, float], bars: tuple[float, float], pedal: tuple[float, float], helmet: Color) -> Mesh:
    """A person who sits on a cycle. seat, bars, pedal: (x, z) of the seat, of the hands and of the feet, metres."""
    hip, shoulder = np.array([seat[0], 0.0, seat[1] + 0.06]), np.array([seat[0] + 0.26, 0.0, seat[1] + 0.56])
    parts = [
        rod(hip, shoulder, 0.16, SHIRT, Material.DYE, 8),
        ball(tuple(shoulder + (0.06, 0, 0.24)), (0.12, 0.1, 0.13), SKIN[1]),
        ball(tuple(shoulder + (0.05, 0, 0.29)), (0.145, 0.115, 0.11), helmet),
    ]
    for side in (-1, 1):
        knee = np.array(
            [(seat[0] + pedal[0]) / 2 + 0.24, side * 0.14, (seat[1] + pedal[1]) / 2 + 0.12 * (1 + side * 0.5)]
        )
        foot = np.array([pedal[0] + 0.08 * side, side * 0.13, pedal[1] + 0.07 * side])
        hand = np.array([bars[0], side * 0.24, bars[1]])
        parts += [
            rod(hip + (0, side * 0.09, 0), knee, 0.08, TROUSERS[0]),
            rod(knee, foot, 0.06, TROUSERS[0]),
            block((foot[0] + 0.05, foot[1], foot[2]), (0.24, 0.09, 0.09), (30, 30, 30)),
            rod(shoulder + (0, side * 0.17, -0.05), hand, 0.055, SHIRT, Material.DYE),
        ]
    return joined(parts)
