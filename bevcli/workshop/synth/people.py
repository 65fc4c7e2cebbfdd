"""Meshes of people, and of bicycles and motorcycles with and without riders."""

import numpy as np

from bevcli.workshop.synth.mesh import (
    HEADLAMP,
    PAINT,
    TAIL_LAMP,
    TRIM,
    Color,
    Finish,
    Material,
    Mesh,
    Row,
    Surface,
    ball,
    block,
    cone,
    crossbar,
    loft,
    made,
    rod,
    side_profile,
)

SKIN: tuple[Color, ...] = ((224, 176, 146), (196, 144, 112), (142, 96, 70), (98, 66, 50))
HAIR: tuple[Color, ...] = ((40, 32, 28), (92, 66, 42), (180, 146, 90), (120, 118, 116))
SHIRT = Finish((120, 120, 120), Material.DYE)
TROUSERS: tuple[Color, ...] = ((44, 52, 76), (52, 50, 50), (112, 98, 78), (78, 84, 92))
PERSON_NAMES = ("man", "woman", "worker", "child", "backpack", "coat")
RUBBER: Color = (24, 24, 26)
CHROME: Color = (176, 178, 182)
CYCLES = {"bicycle": ("city", "racer", "cargo", "mountain"), "motorcycle": ("sport", "cruiser", "scooter")}
RIDDEN = {kind: tuple(f"{name}_rider" for name in names) for kind, names in CYCLES.items()}
Place = tuple[float, float]  # x and z, metres


def person(name: str, stride: int) -> list[Mesh]:
    """The parts of a person, about 1.75 m tall. stride: +1 left leg in front, -1 right leg, 0 standing."""
    k = PERSON_NAMES.index(name)
    skin, hair, legs = SKIN[k % 4], HAIR[(k + 1) % 4], TROUSERS[k % 4]
    swing = 0.26 * stride
    x, z = 0.02, 1.62  # of the middle of the head, metres
    things: dict[str, list[Row]] = {
        "woman": [(cone, 0.55, 1.0, 0.27, 0.17, SHIRT), (ball, (-0.07, 0, 1.58), (0.1, 0.13, 0.18), hair)],
        "worker": [
            (ball, (0.02, 0, 1.73), (0.15, 0.14, 0.09), (250, 210, 40)),
            (block, (0, 0, 1.2), (0.31, 0.43, 0.06), (236, 240, 200)),
        ],
        "backpack": [(block, (-0.2, 0, 1.22), (0.18, 0.32, 0.46), (150, 52, 44))],
        "coat": [(cone, 0.5, 1.3, 0.26, 0.2, SHIRT)],
    }
    return [
        *_leg(0.1, swing, legs),
        *_leg(-0.1, -swing, legs),
        _torso((240, 120, 30) if name == "worker" else SHIRT),
        *_arm(0.25, -swing * 0.9, skin),
        *_arm(-0.25, swing * 0.9, skin),
        rod((x - 0.02, 0, z - 0.2), (x, 0, z - 0.05), 0.055, skin),
        ball((x, 0, z), (0.105, 0.085, 0.125), skin),
        ball((x - 0.025, 0, z + 0.035), (0.105, 0.095, 0.105), hair),
        *made(things.get(name, [])),
    ]


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
        rod((0, y * 0.92, 1.4), elbow, 0.06, SHIRT),
        rod(elbow, hand, 0.048, SHIRT),
        ball(hand, (0.05, 0.05, 0.06), skin, subdivisions=0),
    ]


def _torso(surface: Surface) -> Mesh:
    low, high = 0.86, 1.46  # metres
    angle = np.linspace(0, 2 * np.pi, 8, endpoint=False) + np.pi / 8
    ring = np.stack([0.13 * np.cos(angle), 0.2 * np.sin(angle)], -1)
    levels = ((low, 0.86), ((low + high) / 2, 0.9), (high - 0.08, 1.12), (high, 0.75))
    return loft([np.column_stack([ring * scale, np.full(8, z)]) for z, scale in levels], surface)


def rider(seat: Place, bars: Place, pedal: Place, helmet: Color) -> list[Mesh]:
    """A person who sits on a cycle. seat, bars, pedal: places of the seat, of the hands and of the feet."""
    hip, shoulder = np.array([seat[0], 0.0, seat[1] + 0.06]), np.array([seat[0] + 0.26, 0.0, seat[1] + 0.56])
    parts = [
        rod(hip, shoulder, 0.16, SHIRT, 8),
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
            rod(shoulder + (0, side * 0.17, -0.05), hand, 0.055, SHIRT),
        ]
    return parts


def _thin_wheel(x: float, radius: float, width: float) -> list[Mesh]:
    return [
        crossbar(x, radius, width / 2, radius, RUBBER, 14),
        crossbar(x, radius, width / 2 + 0.005, radius * 0.86, (150, 152, 156), 14),
        crossbar(x, radius, width / 2 + 0.02, radius * 0.15, TRIM),
    ]


def bicycle(name: str) -> list[Mesh]:
    """The parts of a bicycle. name: of CYCLES, or of RIDDEN, on which a person sits."""
    kind = name.removesuffix("_rider")
    reach = {"city": 1.05, "racer": 1.0, "cargo": 1.35, "mountain": 1.08}[kind]
    radius, seat_z, bar_z = 0.34, 0.92, {"city": 1.08, "racer": 0.95, "cargo": 1.05, "mountain": 1.02}[kind]
    back, front = -reach / 2, reach / 2
    crank, seat, head = (-0.05, 0, 0.3), (-0.22, 0, seat_z), (front - 0.2, 0, bar_z - 0.12)
    tube = 0.03
    parts = [
        *_thin_wheel(back, radius, 0.045),
        *_thin_wheel(front, radius, 0.045),
        rod(crank, seat, tube, PAINT, 5),
        rod(seat, head, tube, PAINT, 5),
        rod(crank, head, tube, PAINT, 5),
        rod(crank, (back, 0, radius), 0.025, PAINT, 4),
        rod(seat, (back, 0, radius), 0.02, PAINT, 4),
        rod((front - 0.22, 0, bar_z), (front, 0, radius), 0.028, TRIM, sections=5),
        crossbar(front - 0.24, bar_z, 0.27, 0.022, TRIM, 5),
        block((-0.24, 0, seat_z + 0.03), (0.26, 0.15, 0.06), RUBBER),
        crossbar(-0.05, 0.3, 0.16, 0.03, CHROME, 5),
    ]
    if kind == "city":
        parts += [
            block((back - 0.02, 0, 0.74), (0.42, 0.16, 0.03), TRIM),
            block((front - 0.05, 0, 0.98), (0.3, 0.34, 0.22), (120, 92, 62)),
        ]
    if kind == "cargo":
        parts.append(block((0.32, 0, 0.62), (0.55, 0.5, 0.45), (168, 122, 70)))
    if name.endswith("_rider"):
        helmet = (230, 230, 226) if kind == "racer" else (52, 58, 70)
        parts += rider((-0.24, seat_z + 0.04), (front - 0.24, bar_z), (-0.05, 0.3), helmet)
    return parts


def motorcycle(name: str) -> list[Mesh]:
    """The parts of a motorcycle. name: of CYCLES, or of RIDDEN, on which a person sits."""
    kind = name.removesuffix("_rider")
    radius, reach = (0.24, 1.25) if kind == "scooter" else (0.32, 1.45)
    back, front = -reach / 2, reach / 2
    parts = [crossbar(x, radius, 0.07, radius, RUBBER, 14) for x in (back, front)]
    parts += [crossbar(x, radius, 0.085, radius * 0.55, CHROME, 8) for x in (back, front)]
    bar_z = 1.08 if kind == "cruiser" else 0.98
    parts += [rod((front - 0.28, y, bar_z), (front, y, radius), 0.035, CHROME, sections=5) for y in (-0.1, 0.1)]
    parts += [
        crossbar(front - 0.3, bar_z, 0.36, 0.025, TRIM, 5),
        ball((front - 0.14, 0, bar_z - 0.16), (0.1, 0.11, 0.11), HEADLAMP),
        block((back - 0.12, 0, 0.72), (0.08, 0.2, 0.1), TAIL_LAMP),
    ]
    if kind == "scooter":
        body = [(back - 0.1, 0.35), (back + 0.6, 0.3), (back + 0.55, 0.75), (back - 0.1, 0.78)]
        shield = [(front - 0.42, 0.3), (front - 0.3, 0.28), (front - 0.22, 0.95), (front - 0.34, 0.98)]
        parts += [
            side_profile(body, 0.2, PAINT),
            side_profile(shield, 0.22, PAINT),
            block((0.0, 0, 0.3), (0.6, 0.36, 0.08), TRIM),
            block((back + 0.2, 0, 0.8), (0.7, 0.28, 0.08), RUBBER),
        ]
    else:
        tank_z = 0.82 if kind == "sport" else 0.74
        tank = [(-0.15, 0.62), (0.35, 0.66), (0.38, tank_z), (0.0, tank_z + 0.14), (-0.2, tank_z)]
        tail = [(back - 0.15, 0.66), (back + 0.4, 0.6), (back + 0.4, 0.72), (back - 0.12, 0.82)]
        parts += [
            block((-0.02, 0, 0.45), (0.55, 0.3, 0.36), (70, 70, 74)),
            side_profile(tank, 0.17, PAINT),
            block((-0.42, 0, 0.76), (0.62, 0.26, 0.1), RUBBER),
            side_profile(tail, 0.13, PAINT),
            *[rod((-0.1, y, 0.3), (back - 0.1, y, 0.36), 0.05, CHROME) for y in (-0.17, 0.17)],
        ]
        if kind == "sport":
            fairing = np.array([(-0.42, 0.6), (-0.1, 0.62), (-0.12, 0.9), (-0.3, 1.08), (-0.42, 0.9)]) + (front, 0)
            parts.append(side_profile(fairing, 0.18, PAINT))
    if name.endswith("_rider"):
        seat = (back + 0.35, 0.82) if kind == "scooter" else (-0.4, 0.8)
        parts += rider(seat, (front - 0.3, bar_z), (0.0, 0.36), (200, 30, 34) if kind == "sport" else (34, 36, 40))
    return parts
