"""Meshes of road users: people, bicycles, motorcycles, cars, trucks, trailers and buses."""

from dataclasses import dataclass

import numpy as np

from bevcli.workshop.synth import mesh

SKIN: tuple[mesh.Color, ...] = ((224, 176, 146), (196, 144, 112), (142, 96, 70), (98, 66, 50))
HAIR: tuple[mesh.Color, ...] = ((40, 32, 28), (92, 66, 42), (180, 146, 90), (120, 118, 116))
SHIRT = mesh.Finish((120, 120, 120), mesh.Material.DYE)
TROUSERS: tuple[mesh.Color, ...] = ((44, 52, 76), (52, 50, 50), (112, 98, 78), (78, 84, 92))
PERSON_NAMES = ("man", "woman", "worker", "child", "backpack", "coat")
RUBBER: mesh.Color = (24, 24, 26)
CHROME: mesh.Color = (176, 178, 182)
CYCLES = {"bicycle": ("city", "racer", "cargo", "mountain"), "motorcycle": ("sport", "cruiser", "scooter")}
RIDDEN = {kind: tuple(f"{name}_rider" for name in names) for kind, names in CYCLES.items()}
Place = tuple[float, float]  # x and z, metres


def person(name: str, stride: int) -> list[mesh.Mesh]:
    """The parts of a person, about 1.75 m tall. stride: +1 left leg in front, -1 right leg, 0 standing."""
    k = PERSON_NAMES.index(name)
    skin, hair, legs = SKIN[k % 4], HAIR[(k + 1) % 4], TROUSERS[k % 4]
    swing = 0.26 * stride
    x, z = 0.02, 1.62  # of the middle of the head, metres
    angle = np.linspace(0, 2 * np.pi, 8, endpoint=False) + np.pi / 8
    ring = np.stack([0.13 * np.cos(angle), 0.2 * np.sin(angle)], -1)
    levels = ((0.86, 0.86), ((0.86 + 1.46) / 2, 0.9), (1.46 - 0.08, 1.12), (1.46, 0.75))  # height, metres; width
    torso = [np.column_stack([ring * scale, np.full(8, height)]) for height, scale in levels]
    things: dict[str, list[mesh.Row]] = {
        "woman": [(mesh.cone, 0.55, 1.0, 0.27, 0.17, SHIRT), (mesh.ball, (-0.07, 0, 1.58), (0.1, 0.13, 0.18), hair)],
        "worker": [
            (mesh.ball, (0.02, 0, 1.73), (0.15, 0.14, 0.09), (250, 210, 40)),
            (mesh.block, (0, 0, 1.2), (0.31, 0.43, 0.06), (236, 240, 200)),
        ],
        "backpack": [(mesh.block, (-0.2, 0, 1.22), (0.18, 0.32, 0.46), (150, 52, 44))],
        "coat": [(mesh.cone, 0.5, 1.3, 0.26, 0.2, SHIRT)],
    }
    return [
        *_leg(0.1, swing, legs),
        *_leg(-0.1, -swing, legs),
        mesh.loft(torso, (240, 120, 30) if name == "worker" else SHIRT),
        *_arm(0.25, -swing * 0.9, skin),
        *_arm(-0.25, swing * 0.9, skin),
        mesh.rod((x - 0.02, 0, z - 0.2), (x, 0, z - 0.05), 0.055, skin),
        mesh.ball((x, 0, z), (0.105, 0.085, 0.125), skin),
        mesh.ball((x - 0.025, 0, z + 0.035), (0.105, 0.095, 0.105), hair),
        *mesh.made(things.get(name, [])),
    ]


def _leg(y: float, swing: float, color: mesh.Color) -> list[mesh.Mesh]:
    knee = (swing * 0.6 + 0.03, y, 0.46)
    foot = (swing - 0.03, y, 0.08)
    return [
        mesh.rod((0, y, 0.9), knee, 0.085, color),
        mesh.rod(knee, foot, 0.065, color),
        mesh.block((foot[0] + 0.06, y, 0.05), (0.26, 0.1, 0.1), (36, 32, 30)),
    ]


def _arm(y: float, swing: float, skin: mesh.Color) -> list[mesh.Mesh]:
    elbow, hand = (swing * 0.5 - 0.02, y * 1.04, 1.14), (swing + 0.04, y, 0.9)
    return [
        mesh.rod((0, y * 0.92, 1.4), elbow, 0.06, SHIRT),
        mesh.rod(elbow, hand, 0.048, SHIRT),
        mesh.ball(hand, (0.05, 0.05, 0.06), skin, subdivisions=0),
    ]


def rider(seat: Place, bars: Place, pedal: Place, helmet: mesh.Color) -> list[mesh.Mesh]:
    """A person who sits on a cycle. seat, bars, pedal: places of the seat, of the hands and of the feet."""
    hip, shoulder = np.array([seat[0], 0.0, seat[1] + 0.06]), np.array([seat[0] + 0.26, 0.0, seat[1] + 0.56])
    parts = [
        mesh.rod(hip, shoulder, 0.16, SHIRT, 8),
        mesh.ball(tuple(shoulder + (0.06, 0, 0.24)), (0.12, 0.1, 0.13), SKIN[1]),
        mesh.ball(tuple(shoulder + (0.05, 0, 0.29)), (0.145, 0.115, 0.11), helmet),
    ]
    for side in (-1, 1):
        knee = np.array(
            [(seat[0] + pedal[0]) / 2 + 0.24, side * 0.14, (seat[1] + pedal[1]) / 2 + 0.12 * (1 + side * 0.5)]
        )
        foot = np.array([pedal[0] + 0.08 * side, side * 0.13, pedal[1] + 0.07 * side])
        hand = np.array([bars[0], side * 0.24, bars[1]])
        parts += [
            mesh.rod(hip + (0, side * 0.09, 0), knee, 0.08, TROUSERS[0]),
            mesh.rod(knee, foot, 0.06, TROUSERS[0]),
            mesh.block((foot[0] + 0.05, foot[1], foot[2]), (0.24, 0.09, 0.09), (30, 30, 30)),
            mesh.rod(shoulder + (0, side * 0.17, -0.05), hand, 0.055, SHIRT),
        ]
    return parts


def _thin_wheel(x: float, radius: float, width: float) -> list[mesh.Mesh]:
    return [
        mesh.crossbar(x, radius, width / 2, radius, RUBBER, 14),
        mesh.crossbar(x, radius, width / 2 + 0.005, radius * 0.86, (150, 152, 156), 14),
        mesh.crossbar(x, radius, width / 2 + 0.02, radius * 0.15, mesh.TRIM),
    ]


def bicycle(name: str) -> list[mesh.Mesh]:
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
        mesh.rod(crank, seat, tube, mesh.PAINT, 5),
        mesh.rod(seat, head, tube, mesh.PAINT, 5),
        mesh.rod(crank, head, tube, mesh.PAINT, 5),
        mesh.rod(crank, (back, 0, radius), 0.025, mesh.PAINT, 4),
        mesh.rod(seat, (back, 0, radius), 0.02, mesh.PAINT, 4),
        mesh.rod((front - 0.22, 0, bar_z), (front, 0, radius), 0.028, mesh.TRIM, sections=5),
        mesh.crossbar(front - 0.24, bar_z, 0.27, 0.022, mesh.TRIM, 5),
        mesh.block((-0.24, 0, seat_z + 0.03), (0.26, 0.15, 0.06), RUBBER),
        mesh.crossbar(-0.05, 0.3, 0.16, 0.03, CHROME, 5),
    ]
    if kind == "city":
        parts += [
            mesh.block((back - 0.02, 0, 0.74), (0.42, 0.16, 0.03), mesh.TRIM),
            mesh.block((front - 0.05, 0, 0.98), (0.3, 0.34, 0.22), (120, 92, 62)),
        ]
    if kind == "cargo":
        parts.append(mesh.block((0.32, 0, 0.62), (0.55, 0.5, 0.45), (168, 122, 70)))
    if name.endswith("_rider"):
        helmet = (230, 230, 226) if kind == "racer" else (52, 58, 70)
        parts += rider((-0.24, seat_z + 0.04), (front - 0.24, bar_z), (-0.05, 0.3), helmet)
    return parts


def motorcycle(name: str) -> list[mesh.Mesh]:
    """The parts of a motorcycle. name: of CYCLES, or of RIDDEN, on which a person sits."""
    kind = name.removesuffix("_rider")
    radius, reach = (0.24, 1.25) if kind == "scooter" else (0.32, 1.45)
    back, front = -reach / 2, reach / 2
    parts = [mesh.crossbar(x, radius, 0.07, radius, RUBBER, 14) for x in (back, front)]
    parts += [mesh.crossbar(x, radius, 0.085, radius * 0.55, CHROME, 8) for x in (back, front)]
    bar_z = 1.08 if kind == "cruiser" else 0.98
    parts += [mesh.rod((front - 0.28, y, bar_z), (front, y, radius), 0.035, CHROME, sections=5) for y in (-0.1, 0.1)]
    parts += [
        mesh.crossbar(front - 0.3, bar_z, 0.36, 0.025, mesh.TRIM, 5),
        mesh.ball((front - 0.14, 0, bar_z - 0.16), (0.1, 0.11, 0.11), mesh.HEADLAMP),
        mesh.block((back - 0.12, 0, 0.72), (0.08, 0.2, 0.1), mesh.TAIL_LAMP),
    ]
    if kind == "scooter":
        body = [(back - 0.1, 0.35), (back + 0.6, 0.3), (back + 0.55, 0.75), (back - 0.1, 0.78)]
        shield = [(front - 0.42, 0.3), (front - 0.3, 0.28), (front - 0.22, 0.95), (front - 0.34, 0.98)]
        parts += [
            mesh.side_profile(body, 0.2, mesh.PAINT),
            mesh.side_profile(shield, 0.22, mesh.PAINT),
            mesh.block((0.0, 0, 0.3), (0.6, 0.36, 0.08), mesh.TRIM),
            mesh.block((back + 0.2, 0, 0.8), (0.7, 0.28, 0.08), RUBBER),
        ]
    else:
        tank_z = 0.82 if kind == "sport" else 0.74
        tank = [(-0.15, 0.62), (0.35, 0.66), (0.38, tank_z), (0.0, tank_z + 0.14), (-0.2, tank_z)]
        tail = [(back - 0.15, 0.66), (back + 0.4, 0.6), (back + 0.4, 0.72), (back - 0.12, 0.82)]
        parts += [
            mesh.block((-0.02, 0, 0.45), (0.55, 0.3, 0.36), (70, 70, 74)),
            mesh.side_profile(tank, 0.17, mesh.PAINT),
            mesh.block((-0.42, 0, 0.76), (0.62, 0.26, 0.1), RUBBER),
            mesh.side_profile(tail, 0.13, mesh.PAINT),
            *[mesh.rod((-0.1, y, 0.3), (back - 0.1, y, 0.36), 0.05, CHROME) for y in (-0.17, 0.17)],
        ]
        if kind == "sport":
            fairing = np.array([(-0.42, 0.6), (-0.1, 0.62), (-0.12, 0.9), (-0.3, 1.08), (-0.42, 0.9)]) + (front, 0)
            parts.append(mesh.side_profile(fairing, 0.18, mesh.PAINT))
    if name.endswith("_rider"):
        seat = (back + 0.35, 0.82) if kind == "scooter" else (-0.4, 0.8)
        parts += rider(seat, (front - 0.3, bar_z), (0.0, 0.36), (200, 30, 34) if kind == "sport" else (34, 36, 40))
    return parts


@dataclass(frozen=True)
class CarShape:
    """Proportions of a car, metres.

    cabin: fractions of the length: the rear window's lower and upper edge, the windscreen's upper and lower edge.
    """

    length: float
    width: float
    height: float
    belt: float  # height of the lower edge of the windows
    nose: float  # height of the bonnet's front edge
    tail: float  # height of the boot's rear edge
    cabin: tuple[float, float, float, float]
    wheel_radius: float = 0.33
    clearance: float = 0.2  # height of the body's underside

    def at(self, fraction: float) -> float:
        """x in metres of a fraction of the length, 0 at the tail and 1 at the nose."""
        return (fraction - 0.5) * self.length


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


def car(name: str) -> list[mesh.Mesh]:
    """The parts of a car. name: a key of CAR_SHAPES."""
    s = CAR_SHAPES[name]
    half, roof_half, middle = s.width / 2, s.width / 2 * 0.76, (s.cabin[1] + s.cabin[2]) / 2
    foot = {key: (s.at(s.cabin[key]), s.belt) for key in (0, 3)}
    body = [
        (s.at(0.0), s.clearance + 0.14), (s.at(0.02), s.clearance), (s.at(0.98), s.clearance),
        (s.at(1.0), s.clearance + 0.16), (s.at(0.992), s.nose - 0.12), (s.at(0.95), s.nose), foot[3], foot[0],
        (s.at(0.005), s.tail),
    ]  # fmt: skip
    glass = [foot[0], foot[3], (s.at(s.cabin[2]), s.height), (s.at(s.cabin[1]), s.height)]
    roof = (s.length * (s.cabin[2] - s.cabin[1]) + 0.1, roof_half * 2 + 0.04, 0.06)
    parts = [
        mesh.side_profile(body, half * 0.97, mesh.PAINT, top_half_width=half * 0.93),
        mesh.side_profile(glass, half * 0.92, mesh.GLASS, top_half_width=roof_half),
        mesh.block((s.at(middle), 0, s.height - 0.02), roof, mesh.PAINT),
    ]
    for low, high in ((s.cabin[0], s.cabin[1]), (s.cabin[3], s.cabin[2]), (middle, middle)):  # posts of the cabin
        for side in (-1, 1):
            start, end = (s.at(low), side * half * 0.915, s.belt), (s.at(high), side * roof_half, s.height - 0.02)
            parts.append(mesh.rod(start, end, 0.045, mesh.PAINT, sections=4))
    lamp_z, tail_z, lamp = s.nose - 0.1, s.tail - 0.12, mesh.Finish((255, 250, 230), mesh.Material.GLOW)
    parts += [
        mesh.block((s.at(0.995), 0, s.clearance + 0.2), (0.06, half * 1.5, 0.16), mesh.TRIM),
        mesh.block((s.at(0.99), 0, lamp_z - 0.06), (0.08, half * 0.9, 0.12), mesh.TRIM),
        mesh.block((s.at(0.005), 0, s.clearance + 0.2), (0.06, half * 1.6, 0.16), mesh.TRIM),
        mesh.block((s.at(0.0), 0, s.clearance + 0.42), (0.04, 0.5, 0.12), (225, 225, 220)),
        mesh.block((s.at(1.0), 0, s.clearance + 0.26), (0.04, 0.5, 0.11), (225, 225, 220)),
        mesh.twin_blocks((s.at(0.98), half * 0.74, lamp_z), (0.16, half * 0.34, 0.13), lamp),
        mesh.twin_blocks((s.at(0.012), half * 0.76, tail_z), (0.1, half * 0.3, 0.16), mesh.TAIL_LAMP),
        mesh.twin_blocks((s.at(s.cabin[3] - 0.04), half * 0.95, s.belt + 0.07), (0.14, half * 0.1, 0.12), mesh.TRIM),
        mesh.twin_blocks((s.at(0.5), half * 0.955, s.clearance + 0.05), (s.length * 0.5, 0.06, 0.1), mesh.TRIM),
    ]
    for side in (-1, 1):
        for x in (s.at(0.185), s.at(0.81)):
            z, y = s.wheel_radius + 0.02, side * half
            parts.append(mesh.rod((x, y * 0.8, z), (x, y * 0.972, z), s.wheel_radius + 0.05, (12, 12, 13), sections=12))
            parts.append(mesh.wheel(x, side * (half - 0.12), s.wheel_radius, 0.22))
    if name == "taxi":
        sign = mesh.Finish((255, 214, 90), mesh.Material.GLOW)
        parts.append(mesh.block((s.at(0.42), 0, s.height + 0.09), (0.22, 0.6, 0.16), sign))
    return parts


TRUCK_NAMES = ("pickup", "delivery", "box", "flatbed", "tanker", "dumper", "garbage", "tractor")
_TRUCK_SIZES = {
    "box": (7.6, 3.3), "flatbed": (8.0, 2.7), "tanker": (8.4, 3.1), "dumper": (7.4, 3.1), "garbage": (8.2, 3.3),
    "tractor": (6.2, 3.2),
}  # length and height, metres, of trucks with a cab before their load  # fmt: skip
PICKUP_BODY = [(-2.8, 0.55), (-2.7, 0.35), (2.7, 0.35), (2.8, 0.6), (2.75, 1.05), (1.2, 1.15), (-2.8, 1.1)]
DELIVERY_BODY = [(-3.1, 0.4), (3.0, 0.4), (3.1, 0.7), (3.0, 1.15), (2.3, 1.35), (1.75, 2.4), (1.3, 2.75), (-3.1, 2.75)]
_SMALL_TRUCKS: dict[str, tuple[mesh.Row, ...]] = {
    "pickup": (
        (mesh.side_profile, PICKUP_BODY, 0.98, mesh.PAINT),
        (mesh.side_profile, [(-0.65, 1.12), (1.35, 1.12), (0.75, 1.83), (-0.5, 1.83)], 0.9, mesh.GLASS, 0.0, 0.76),
        (mesh.block, (0.12, 0, 1.83), (1.35, 1.56, 0.07), mesh.PAINT),
        (mesh.block, (-1.75, 0, 1.1), (1.9, 1.6, 0.06), (20, 20, 22)),
        (mesh.twin_blocks, (-1.8, 0.9, 1.2), (2.0, 0.14, 0.18), mesh.PAINT),
        (mesh.block, (-2.72, 0, 1.2), (0.12, 1.9, 0.18), mesh.PAINT),
        (mesh.block, (2.78, 0, 0.82), (0.08, 1.0, 0.25), mesh.TRIM),
        (mesh.block, (2.76, 0, 0.5), (0.1, 1.9, 0.2), mesh.TRIM),
        (mesh.block, (-2.78, 0, 0.5), (0.1, 1.9, 0.18), mesh.TRIM),
        (mesh.twin_blocks, (2.74, 0.78, 0.88), (0.12, 0.3, 0.18), mesh.HEADLAMP),
        (mesh.twin_blocks, (-2.78, 0.86, 0.95), (0.06, 0.18, 0.3), mesh.TAIL_LAMP),
        *[(mesh.rod, (-0.6, side * 0.89, 1.12), (-0.48, side * 0.77, 1.82), 0.05, mesh.PAINT, 4) for side in (-1, 1)],
        *[(mesh.rod, (0.3, side * 0.89, 1.12), (0.2, side * 0.77, 1.82), 0.05, mesh.PAINT, 4) for side in (-1, 1)],
        *[(mesh.rod, (1.3, side * 0.89, 1.12), (0.74, side * 0.77, 1.82), 0.05, mesh.PAINT, 4) for side in (-1, 1)],
        (mesh.axles, (-1.75, 1.85), 0.84, 0.4, 0.3),
    ),
    "delivery": (
        (mesh.side_profile, DELIVERY_BODY, 1.0, mesh.PAINT, 0.0, 0.95),
        (mesh.side_profile, [(1.72, 1.45), (2.36, 1.4), (1.83, 2.4), (1.4, 2.5)], 0.93, mesh.GLASS, 0.0, 0.9),
        (mesh.block, (1.45, 0, 1.85), (0.8, 1.985, 0.7), mesh.GLASS),
        (mesh.block, (-0.9, 0, 1.7), (3.2, 2.0, 0.35), mesh.CARGO),
        (mesh.block, (3.06, 0, 0.6), (0.1, 1.9, 0.25), mesh.TRIM),
        (mesh.block, (-3.08, 0, 0.5), (0.1, 1.9, 0.2), mesh.TRIM),
        (mesh.block, (-3.1, 0, 1.7), (0.04, 0.04, 1.9), mesh.TRIM),
        (mesh.twin_blocks, (3.02, 0.75, 0.92), (0.14, 0.34, 0.2), mesh.HEADLAMP),
        (mesh.twin_blocks, (-3.1, 0.9, 1.3), (0.06, 0.14, 0.5), mesh.TAIL_LAMP),
        (mesh.axles, (-1.9, 2.05), 0.84, 0.37, 0.3),
    ),
}  # the other trucks, whole


def truck(name: str) -> list[mesh.Mesh]:
    """The parts of a truck. name: one of TRUCK_NAMES."""
    if name in _SMALL_TRUCKS:
        return mesh.made(_SMALL_TRUCKS[name])
    length, height = _TRUCK_SIZES[name]
    half, rear = 1.2, -length / 2
    bed = length - 2.3
    return [
        *_cab(length / 2, half, min(height, 3.0)),
        mesh.block((rear + bed / 2, 0, 0.85), (bed, 1.0, 0.3), mesh.TRIM),
        mesh.axles((rear + 1.1, rear + 2.4, length / 2 - 1.2), half - 0.16, 0.5, 0.3),
        *mesh.made(_loads(rear, bed, half, height)[name]),
        mesh.twin_blocks((rear + 0.03, half * 0.8, 0.9), (0.08, 0.3, 0.16), mesh.TAIL_LAMP),
    ]


def _loads(rear: float, bed: float, half: float, height: float) -> dict[str, list[mesh.Row]]:
    """The body behind the cab of each truck. rear: x of its end; bed: its length; half: half its width; metres."""
    middle, front = rear + bed / 2, rear + bed
    skip = [(rear + 0.15, 1.1), (front - 0.3, 1.1), (front - 0.1, height - 0.2), (rear, height - 0.5)]
    hold = [(rear + 0.9, 1.0), (front - 0.1, 1.0), (front - 0.1, height), (rear + 0.9, height)]
    hatch = [(rear, 0.7), (rear + 0.95, 0.7), (rear + 0.95, height - 0.1), (rear + 0.35, height - 0.3)]
    return {
        "box": [
            (mesh.block, (middle, 0, height / 2 + 0.5), (bed, 2 * half, height - 1.0), mesh.CARGO),
            (mesh.block, (middle, 0, 1.3), (bed + 0.02, 2 * half + 0.02, 0.5), mesh.PAINT),
        ],
        "flatbed": [
            (mesh.block, (middle, 0, 1.1), (bed, 2 * half, 0.18), (112, 92, 70)),
            (mesh.block, (middle + 0.6, 0.1, 1.7), (2.2, 1.8, 1.0), (150, 116, 80)),
            (mesh.block, (middle - 1.6, -0.2, 1.5), (1.5, 1.6, 0.7), (120, 124, 126)),
            (mesh.block, (front - 0.06, 0, 1.7), (0.1, 2 * half, 1.1), mesh.TRIM),
        ],
        "tanker": [
            (mesh.rod, (rear + 0.1, 0, 2.05), (front - 0.15, 0, 2.05), 1.05, mesh.CARGO, 12),
            (mesh.block, (middle, 0, 3.08), (bed * 0.5, 0.5, 0.06), mesh.TRIM),
        ],
        "dumper": [
            (mesh.side_profile, skip, half, mesh.DYED_PAINT),
            *[(mesh.twin_blocks, (x, half, 1.9), (0.1, 0.06, 1.4), mesh.TRIM) for x in (rear + 1, middle, front - 1)],
        ],
        "garbage": [
            (mesh.side_profile, hold, half, mesh.DYED_PAINT),
            (mesh.side_profile, hatch, half * 0.96, (90, 96, 92)),
        ],
        "tractor": [
            (mesh.block, (rear + 1.6, 0, 1.15), (1.2, 0.9, 0.14), (70, 70, 72)),
            (mesh.rod, (front - 0.2, 0.8, 1), (front - 0.2, 0.8, height), 0.08, (180, 182, 184)),
        ],
    }


def _cab(nose: float, half: float, height: float) -> list[mesh.Mesh]:
    """A driver's cab whose front is at x = nose."""
    back = nose - 2.1
    body = [(back, 0.6), (nose, 0.45), (nose, 1.5), (nose - 0.12, height - 0.25), (nose - 0.5, height), (back, height)]
    glass = [(nose - 0.4, 1.55), (nose + 0.015, 1.55), (nose - 0.1, 2.4), (nose - 0.4, 2.4)]
    return [
        mesh.side_profile(body, half * 0.98, mesh.PAINT, top_half_width=half * 0.94),
        mesh.side_profile(glass, half * 0.9, mesh.GLASS),
        mesh.block((nose - 0.95, 0, 1.95), (0.9, half * 1.955, 0.75), mesh.GLASS),
        mesh.block((nose, 0, 1.15), (0.05, half * 1.2, 0.4), mesh.TRIM),
        mesh.block((nose - 0.03, 0, 0.6), (0.12, half * 1.96, 0.3), mesh.TRIM),
        mesh.twin_blocks((nose, half * 0.78, 0.8), (0.06, 0.34, 0.18), mesh.HEADLAMP),
        mesh.twin_blocks((nose - 0.15, half - 0.05, 2.0), (0.12, 0.1, 0.5), mesh.TRIM),
    ]


TRAILER_NAMES = ("box", "curtain", "container", "tanker", "flatbed", "utility")
_UTILITY_TRAILER: tuple[mesh.Row, ...] = (
    (mesh.block, (-0.5, 0, 0.75), (3.6, 1.9, 0.12), (96, 92, 86)),
    (mesh.twin_blocks, (-0.5, 0.93, 1.05), (3.6, 0.06, 0.6), mesh.PAINT),
    (mesh.block, (-2.28, 0, 1.05), (0.06, 1.9, 0.6), mesh.PAINT),
    (mesh.block, (1.28, 0, 1.05), (0.06, 1.9, 0.6), mesh.PAINT),
    (mesh.rod, (1.2, 0, 0.6), (2.4, 0, 0.5), 0.06, mesh.TRIM),
    (mesh.block, (-0.4, 0.1, 1.3), (2.2, 1.3, 0.7), (140, 110, 78)),
    (mesh.axles, (-0.7,), 1.08 - 0.16, 0.34, 0.3),
    (mesh.twin_blocks, (-2.3, 0.8, 0.7), (0.06, 0.2, 0.12), mesh.TAIL_LAMP),
)


def trailer(name: str) -> list[mesh.Mesh]:
    """The parts of a trailer. name: one of TRAILER_NAMES."""
    if name == "utility":
        return mesh.made(_UTILITY_TRAILER)
    half, front, rear = 1.27, 6.2, -6.2
    return [
        mesh.block((0, 0, 1.1), (12.4, 1.0, 0.28), mesh.TRIM),
        mesh.block((front - 2.6, 0, 0.6), (0.2, 1.4, 0.9), mesh.TRIM),
        mesh.block((rear + 0.08, 0, 0.6), (0.12, 2.3, 0.2), mesh.TRIM),
        mesh.axles((rear + 1.2, rear + 2.5, rear + 3.8), half - 0.16, 0.5, 0.3),
        *mesh.made(_cargo(name, front, half)),
        mesh.twin_blocks((rear - 0.01, half * 0.8, 1.1), (0.06, 0.3, 0.16), mesh.TAIL_LAMP),
    ]


def _cargo(name: str, front: float, half: float) -> list[mesh.Row]:
    """Everything above a trailer's frame. front: half its length; half: half its width; metres."""
    length, rear = 2 * front, -front
    if name == "tanker":
        silver = mesh.Finish((198, 200, 202), mesh.Material.PAINT)
        tank = (mesh.rod, (rear + 0.05, 0, 2.35), (front - 0.05, 0, 2.35), 1.1, silver, 12)
        return [tank, (mesh.block, (0, 0, 3.45), (length * 0.7, 0.5, 0.08), mesh.TRIM)]
    if name == "flatbed":
        logs = [(y, 1.75, 0.38, (128, 104, 84)) for y in (-0.8, 0, 0.8)]
        logs += [(y, 2.35, 0.36, (138, 112, 90)) for y in (-0.4, 0.4)]
        return [
            (mesh.block, (0, 0, 1.3), (length, 2 * half, 0.16), (120, 98, 74)),
            (mesh.block, (front - 0.06, 0, 1.9), (0.12, 2 * half, 1.3), mesh.PAINT),
            *[(mesh.rod, (rear + 1.2, y, z), (front - 1.5, y, z), radius, color, 8) for y, z, radius, color in logs],
        ]
    height, ribs = (3.8, int(length / 0.8)) if name == "container" else (3.9, 4)
    rib = (0.1, 2 * half + 0.05, height - 1.3)
    rows = [
        (mesh.block, (0, 0, height / 2 + 0.62), (length, 2 * half, height - 1.24), mesh.CARGO),
        *[(mesh.block, (rear + (k + 0.5) * length / ribs, 0, height / 2 + 0.62), rib, mesh.PAINT) for k in range(ribs)],
        (mesh.block, (rear, 0, height / 2 + 0.6), (0.05, 0.06, height - 1.4), mesh.TRIM),
    ]
    curtain = (mesh.block, (0, 0, height - 1.1), (length * 0.5, 2 * half + 0.03, 0.8), mesh.PAINT)
    return [*rows, curtain] if name == "curtain" else rows


BUSES = {
    "city": (12.0, 3.1, 0.35), "coach": (12.4, 3.6, 0.5), "school": (10.4, 3.1, 0.6), "mini": (7.2, 2.8, 0.35),
    "double": (10.8, 4.2, 0.35), "shuttle": (8.6, 3.0, 0.35), "articulated": (15.5, 3.1, 0.35),
}  # length, height, and height of the floor, metres  # fmt: skip


def bus(name: str) -> list[mesh.Mesh]:
    """The parts of a bus. name: a key of BUSES."""
    length, height, floor = BUSES[name]
    half, front = 1.28, length / 2
    slope = 0.5 if name == "coach" else 0.12
    nose, start = (front - 1.5 if name == "school" else front), -front + 0.7  # of the windows
    body = [
        (-front, floor), (nose, floor), (nose, 1.3), (nose - slope, height - 0.1), (nose - slope - 0.15, height),
        (-front + 0.1, height),
    ]  # fmt: skip
    parts = [mesh.side_profile(body, half, mesh.PAINT, top_half_width=half * 0.96)]
    for low, high in {"double": [(1.2, 1.95), (2.65, 3.5)], "coach": [(1.9, 3.0)]}.get(name, [(1.35, 2.35)]):
        z = (low + high) / 2
        count = max(int((nose - 1.0 - start) / 1.4), 2)
        width = (nose - 1.0 - start) / count
        size = (width - 0.14, half * 1.985, high - low)
        parts += [mesh.block((start + (k + 0.5) * width, 0, z), size, mesh.GLASS) for k in range(count)]
        parts.append(
            mesh.block((nose - slope / 2, 0, z + 0.05), (0.06 + slope * 0.5, half * 1.8, high - low + 0.25), mesh.GLASS)
        )
        parts.append(mesh.block((-front + 0.02, 0, z), (0.08, half * 1.5, high - low), mesh.GLASS))
    if name == "school":
        parts.append(mesh.block((front - 0.75, 0, 1.05), (1.5, half * 1.7, 1.1), mesh.PAINT))
        parts.append(mesh.block((front, 0, 0.95), (0.05, 1.3, 0.6), mesh.TRIM))
    if name == "articulated":
        parts.append(mesh.block((-1.5, 0, height / 2 + 0.15), (0.8, half * 1.99, height - 0.5), (40, 40, 42)))
    if name not in ("coach", "school"):
        display = mesh.Finish((255, 170, 40), mesh.Material.GLOW)
        parts.append(mesh.block((nose - 0.05, 0, min(height - 0.25, 2.75)), (0.12, 1.7, 0.28), display))
        parts += [mesh.block((x, -half + 0.01, 1.4), (1.1, 0.05, 2.0), mesh.GLASS) for x in (nose - 1.0, 0.0)]
    positions = (-front * 0.55, front * 0.58) if name != "articulated" else (-front * 0.6, -0.2, front * 0.65)
    return [
        *parts,
        mesh.block((0, 0, floor + 0.35), (length * 0.92, half * 2.01, 0.22), mesh.CARGO),
        mesh.twin_blocks((front - 0.02, half * 0.75, 0.75), (0.08, 0.4, 0.2), mesh.HEADLAMP),
        mesh.twin_blocks((-front, half * 0.82, 1.0), (0.06, 0.22, 0.4), mesh.TAIL_LAMP),
        mesh.axles(positions, half + 0.02 - 0.16, 0.46, 0.3),
    ]
