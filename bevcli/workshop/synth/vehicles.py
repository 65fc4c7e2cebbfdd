"""Meshes of cars, trucks, trailers and buses."""

from dataclasses import dataclass

from bevcli.workshop.synth.mesh import (
    CARGO,
    DYED_PAINT,
    GLASS,
    HEADLAMP,
    PAINT,
    TAIL_LAMP,
    TRIM,
    Finish,
    Material,
    Mesh,
    Row,
    axles,
    block,
    made,
    rod,
    side_profile,
    twin_blocks,
    wheel,
)


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


def car(name: str) -> list[Mesh]:
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
        side_profile(body, half * 0.97, PAINT, top_half_width=half * 0.93),
        side_profile(glass, half * 0.92, GLASS, top_half_width=roof_half),
        block((s.at(middle), 0, s.height - 0.02), roof, PAINT),
    ]
    for low, high in ((s.cabin[0], s.cabin[1]), (s.cabin[3], s.cabin[2]), (middle, middle)):  # posts of the cabin
        for side in (-1, 1):
            start, end = (s.at(low), side * half * 0.915, s.belt), (s.at(high), side * roof_half, s.height - 0.02)
            parts.append(rod(start, end, 0.045, PAINT, sections=4))
    parts += _details(s, half)
    if name == "taxi":
        parts.append(block((s.at(0.42), 0, s.height + 0.09), (0.22, 0.6, 0.16), Finish((255, 214, 90), Material.GLOW)))
    return parts


def _details(s: CarShape, half: float) -> list[Mesh]:
    lamp_z, tail_z, lamp = s.nose - 0.1, s.tail - 0.12, Finish((255, 250, 230), Material.GLOW)
    parts = [
        block((s.at(0.995), 0, s.clearance + 0.2), (0.06, half * 1.5, 0.16), TRIM),
        block((s.at(0.99), 0, lamp_z - 0.06), (0.08, half * 0.9, 0.12), TRIM),
        block((s.at(0.005), 0, s.clearance + 0.2), (0.06, half * 1.6, 0.16), TRIM),
        block((s.at(0.0), 0, s.clearance + 0.42), (0.04, 0.5, 0.12), (225, 225, 220)),
        block((s.at(1.0), 0, s.clearance + 0.26), (0.04, 0.5, 0.11), (225, 225, 220)),
        twin_blocks((s.at(0.98), half * 0.74, lamp_z), (0.16, half * 0.34, 0.13), lamp),
        twin_blocks((s.at(0.012), half * 0.76, tail_z), (0.1, half * 0.3, 0.16), TAIL_LAMP),
        twin_blocks((s.at(s.cabin[3] - 0.04), half * 0.95, s.belt + 0.07), (0.14, half * 0.1, 0.12), TRIM),
        twin_blocks((s.at(0.5), half * 0.955, s.clearance + 0.05), (s.length * 0.5, 0.06, 0.1), TRIM),
    ]
    for side in (-1, 1):
        for x in (s.at(0.185), s.at(0.81)):
            z, y = s.wheel_radius + 0.02, side * half
            parts.append(rod((x, y * 0.8, z), (x, y * 0.972, z), s.wheel_radius + 0.05, (12, 12, 13), sections=12))
            parts.append(wheel(x, side * (half - 0.12), s.wheel_radius, 0.22))
    return parts


TRUCK_NAMES = ("pickup", "delivery", "box", "flatbed", "tanker", "dumper", "garbage", "tractor")
_TRUCK_SIZES = {
    "box": (7.6, 3.3), "flatbed": (8.0, 2.7), "tanker": (8.4, 3.1), "dumper": (7.4, 3.1), "garbage": (8.2, 3.3),
    "tractor": (6.2, 3.2),
}  # length and height, metres, of trucks with a cab before their load  # fmt: skip
PICKUP_BODY = [(-2.8, 0.55), (-2.7, 0.35), (2.7, 0.35), (2.8, 0.6), (2.75, 1.05), (1.2, 1.15), (-2.8, 1.1)]
DELIVERY_BODY = [(-3.1, 0.4), (3.0, 0.4), (3.1, 0.7), (3.0, 1.15), (2.3, 1.35), (1.75, 2.4), (1.3, 2.75), (-3.1, 2.75)]
_SMALL_TRUCKS: dict[str, tuple[Row, ...]] = {
    "pickup": (
        (side_profile, PICKUP_BODY, 0.98, PAINT),
        (side_profile, [(-0.65, 1.12), (1.35, 1.12), (0.75, 1.83), (-0.5, 1.83)], 0.9, GLASS, 0.0, 0.76),
        (block, (0.12, 0, 1.83), (1.35, 1.56, 0.07), PAINT),
        (block, (-1.75, 0, 1.1), (1.9, 1.6, 0.06), (20, 20, 22)),
        (twin_blocks, (-1.8, 0.9, 1.2), (2.0, 0.14, 0.18), PAINT),
        (block, (-2.72, 0, 1.2), (0.12, 1.9, 0.18), PAINT),
        (block, (2.78, 0, 0.82), (0.08, 1.0, 0.25), TRIM),
        (block, (2.76, 0, 0.5), (0.1, 1.9, 0.2), TRIM),
        (block, (-2.78, 0, 0.5), (0.1, 1.9, 0.18), TRIM),
        (twin_blocks, (2.74, 0.78, 0.88), (0.12, 0.3, 0.18), HEADLAMP),
        (twin_blocks, (-2.78, 0.86, 0.95), (0.06, 0.18, 0.3), TAIL_LAMP),
        *[(rod, (-0.6, side * 0.89, 1.12), (-0.48, side * 0.77, 1.82), 0.05, PAINT, 4) for side in (-1, 1)],
        *[(rod, (0.3, side * 0.89, 1.12), (0.2, side * 0.77, 1.82), 0.05, PAINT, 4) for side in (-1, 1)],
        *[(rod, (1.3, side * 0.89, 1.12), (0.74, side * 0.77, 1.82), 0.05, PAINT, 4) for side in (-1, 1)],
        (axles, (-1.75, 1.85), 0.84, 0.4, 0.3),
    ),
    "delivery": (
        (side_profile, DELIVERY_BODY, 1.0, PAINT, 0.0, 0.95),
        (side_profile, [(1.72, 1.45), (2.36, 1.4), (1.83, 2.4), (1.4, 2.5)], 0.93, GLASS, 0.0, 0.9),
        (block, (1.45, 0, 1.85), (0.8, 1.985, 0.7), GLASS),
        (block, (-0.9, 0, 1.7), (3.2, 2.0, 0.35), CARGO),
        (block, (3.06, 0, 0.6), (0.1, 1.9, 0.25), TRIM),
        (block, (-3.08, 0, 0.5), (0.1, 1.9, 0.2), TRIM),
        (block, (-3.1, 0, 1.7), (0.04, 0.04, 1.9), TRIM),
        (twin_blocks, (3.02, 0.75, 0.92), (0.14, 0.34, 0.2), HEADLAMP),
        (twin_blocks, (-3.1, 0.9, 1.3), (0.06, 0.14, 0.5), TAIL_LAMP),
        (axles, (-1.9, 2.05), 0.84, 0.37, 0.3),
    ),
}  # the other trucks, whole


def truck(name: str) -> list[Mesh]:
    """The parts of a truck. name: one of TRUCK_NAMES."""
    if name in _SMALL_TRUCKS:
        return made(_SMALL_TRUCKS[name])
    length, height = _TRUCK_SIZES[name]
    half, rear = 1.2, -length / 2
    bed = length - 2.3
    return [
        *_cab(length / 2, half, min(height, 3.0)),
        block((rear + bed / 2, 0, 0.85), (bed, 1.0, 0.3), TRIM),
        axles((rear + 1.1, rear + 2.4, length / 2 - 1.2), half - 0.16, 0.5, 0.3),
        *made(_loads(rear, bed, half, height)[name]),
        twin_blocks((rear + 0.03, half * 0.8, 0.9), (0.08, 0.3, 0.16), TAIL_LAMP),
    ]


def _loads(rear: float, bed: float, half: float, height: float) -> dict[str, list[Row]]:
    """The body behind the cab of each truck. rear: x of its end; bed: its length; half: half its width; metres."""
    middle, front = rear + bed / 2, rear + bed
    skip = [(rear + 0.15, 1.1), (front - 0.3, 1.1), (front - 0.1, height - 0.2), (rear, height - 0.5)]
    hold = [(rear + 0.9, 1.0), (front - 0.1, 1.0), (front - 0.1, height), (rear + 0.9, height)]
    hatch = [(rear, 0.7), (rear + 0.95, 0.7), (rear + 0.95, height - 0.1), (rear + 0.35, height - 0.3)]
    return {
        "box": [
            (block, (middle, 0, height / 2 + 0.5), (bed, 2 * half, height - 1.0), CARGO),
            (block, (middle, 0, 1.3), (bed + 0.02, 2 * half + 0.02, 0.5), PAINT),
        ],
        "flatbed": [
            (block, (middle, 0, 1.1), (bed, 2 * half, 0.18), (112, 92, 70)),
            (block, (middle + 0.6, 0.1, 1.7), (2.2, 1.8, 1.0), (150, 116, 80)),
            (block, (middle - 1.6, -0.2, 1.5), (1.5, 1.6, 0.7), (120, 124, 126)),
            (block, (front - 0.06, 0, 1.7), (0.1, 2 * half, 1.1), TRIM),
        ],
        "tanker": [
            (rod, (rear + 0.1, 0, 2.05), (front - 0.15, 0, 2.05), 1.05, CARGO, 12),
            (block, (middle, 0, 3.08), (bed * 0.5, 0.5, 0.06), TRIM),
        ],
        "dumper": [
            (side_profile, skip, half, DYED_PAINT),
            *[(twin_blocks, (x, half, 1.9), (0.1, 0.06, 1.4), TRIM) for x in (rear + 1, middle, front - 1)],
        ],
        "garbage": [(side_profile, hold, half, DYED_PAINT), (side_profile, hatch, half * 0.96, (90, 96, 92))],
        "tractor": [
            (block, (rear + 1.6, 0, 1.15), (1.2, 0.9, 0.14), (70, 70, 72)),
            (rod, (front - 0.2, 0.8, 1), (front - 0.2, 0.8, height), 0.08, (180, 182, 184)),
        ],
    }


def _cab(nose: float, half: float, height: float) -> list[Mesh]:
    """A driver's cab whose front is at x = nose."""
    back = nose - 2.1
    body = [(back, 0.6), (nose, 0.45), (nose, 1.5), (nose - 0.12, height - 0.25), (nose - 0.5, height), (back, height)]
    glass = [(nose - 0.4, 1.55), (nose + 0.015, 1.55), (nose - 0.1, 2.4), (nose - 0.4, 2.4)]
    return [
        side_profile(body, half * 0.98, PAINT, top_half_width=half * 0.94),
        side_profile(glass, half * 0.9, GLASS),
        block((nose - 0.95, 0, 1.95), (0.9, half * 1.955, 0.75), GLASS),
        block((nose, 0, 1.15), (0.05, half * 1.2, 0.4), TRIM),
        block((nose - 0.03, 0, 0.6), (0.12, half * 1.96, 0.3), TRIM),
        twin_blocks((nose, half * 0.78, 0.8), (0.06, 0.34, 0.18), HEADLAMP),
        twin_blocks((nose - 0.15, half - 0.05, 2.0), (0.12, 0.1, 0.5), TRIM),
    ]


TRAILER_NAMES = ("box", "curtain", "container", "tanker", "flatbed", "utility")
_UTILITY_TRAILER: tuple[Row, ...] = (
    (block, (-0.5, 0, 0.75), (3.6, 1.9, 0.12), (96, 92, 86)),
    (twin_blocks, (-0.5, 0.93, 1.05), (3.6, 0.06, 0.6), PAINT),
    (block, (-2.28, 0, 1.05), (0.06, 1.9, 0.6), PAINT),
    (block, (1.28, 0, 1.05), (0.06, 1.9, 0.6), PAINT),
    (rod, (1.2, 0, 0.6), (2.4, 0, 0.5), 0.06, TRIM),
    (block, (-0.4, 0.1, 1.3), (2.2, 1.3, 0.7), (140, 110, 78)),
    (axles, (-0.7,), 1.08 - 0.16, 0.34, 0.3),
    (twin_blocks, (-2.3, 0.8, 0.7), (0.06, 0.2, 0.12), TAIL_LAMP),
)


def trailer(name: str) -> list[Mesh]:
    """The parts of a trailer. name: one of TRAILER_NAMES."""
    if name == "utility":
        return made(_UTILITY_TRAILER)
    half, front, rear = 1.27, 6.2, -6.2
    return [
        block((0, 0, 1.1), (12.4, 1.0, 0.28), TRIM),
        block((front - 2.6, 0, 0.6), (0.2, 1.4, 0.9), TRIM),
        block((rear + 0.08, 0, 0.6), (0.12, 2.3, 0.2), TRIM),
        axles((rear + 1.2, rear + 2.5, rear + 3.8), half - 0.16, 0.5, 0.3),
        *made(_cargo(name, front, half)),
        twin_blocks((rear - 0.01, half * 0.8, 1.1), (0.06, 0.3, 0.16), TAIL_LAMP),
    ]


def _cargo(name: str, front: float, half: float) -> list[Row]:
    """Everything above a trailer's frame. front: half its length; half: half its width; metres."""
    length, rear = 2 * front, -front
    if name == "tanker":
        silver = Finish((198, 200, 202), Material.PAINT)
        tank = (rod, (rear + 0.05, 0, 2.35), (front - 0.05, 0, 2.35), 1.1, silver, 12)
        return [tank, (block, (0, 0, 3.45), (length * 0.7, 0.5, 0.08), TRIM)]
    if name == "flatbed":
        logs = [(y, 1.75, 0.38, (128, 104, 84)) for y in (-0.8, 0, 0.8)]
        logs += [(y, 2.35, 0.36, (138, 112, 90)) for y in (-0.4, 0.4)]
        return [
            (block, (0, 0, 1.3), (length, 2 * half, 0.16), (120, 98, 74)),
            (block, (front - 0.06, 0, 1.9), (0.12, 2 * half, 1.3), PAINT),
            *[(rod, (rear + 1.2, y, z), (front - 1.5, y, z), radius, color, 8) for y, z, radius, color in logs],
        ]
    height, ribs = (3.8, int(length / 0.8)) if name == "container" else (3.9, 4)
    rib = (0.1, 2 * half + 0.05, height - 1.3)
    rows = [
        (block, (0, 0, height / 2 + 0.62), (length, 2 * half, height - 1.24), CARGO),
        *[(block, (rear + (k + 0.5) * length / ribs, 0, height / 2 + 0.62), rib, PAINT) for k in range(ribs)],
        (block, (rear, 0, height / 2 + 0.6), (0.05, 0.06, height - 1.4), TRIM),
    ]
    curtain = (block, (0, 0, height - 1.1), (length * 0.5, 2 * half + 0.03, 0.8), PAINT)
    return [*rows, curtain] if name == "curtain" else rows


BUSES = {
    "city": (12.0, 3.1, 0.35), "coach": (12.4, 3.6, 0.5), "school": (10.4, 3.1, 0.6), "mini": (7.2, 2.8, 0.35),
    "double": (10.8, 4.2, 0.35), "shuttle": (8.6, 3.0, 0.35), "articulated": (15.5, 3.1, 0.35),
}  # length, height, and height of the floor, metres  # fmt: skip


def bus(name: str) -> list[Mesh]:
    """The parts of a bus. name: a key of BUSES."""
    length, height, floor = BUSES[name]
    half, front = 1.28, length / 2
    slope = 0.5 if name == "coach" else 0.12
    nose = front - 1.5 if name == "school" else front
    body = [
        (-front, floor), (nose, floor), (nose, 1.3), (nose - slope, height - 0.1), (nose - slope - 0.15, height),
        (-front + 0.1, height),
    ]  # fmt: skip
    parts = [side_profile(body, half, PAINT, top_half_width=half * 0.96)]
    for low, high in {"double": [(1.2, 1.95), (2.65, 3.5)], "coach": [(1.9, 3.0)]}.get(name, [(1.35, 2.35)]):
        z = (low + high) / 2
        parts += _bus_windows(-front + 0.7, nose - 1.0, z, high - low, half)
        parts.append(block((nose - slope / 2, 0, z + 0.05), (0.06 + slope * 0.5, half * 1.8, high - low + 0.25), GLASS))
        parts.append(block((-front + 0.02, 0, z), (0.08, half * 1.5, high - low), GLASS))
    if name == "school":
        parts.append(block((front - 0.75, 0, 1.05), (1.5, half * 1.7, 1.1), PAINT))
        parts.append(block((front, 0, 0.95), (0.05, 1.3, 0.6), TRIM))
    if name == "articulated":
        parts.append(block((-1.5, 0, height / 2 + 0.15), (0.8, half * 1.99, height - 0.5), (40, 40, 42)))
    if name not in ("coach", "school"):
        display = Finish((255, 170, 40), Material.GLOW)
        parts.append(block((nose - 0.05, 0, min(height - 0.25, 2.75)), (0.12, 1.7, 0.28), display))
        parts += [block((x, -half + 0.01, 1.4), (1.1, 0.05, 2.0), GLASS) for x in (nose - 1.0, 0.0)]
    positions = (-front * 0.55, front * 0.58) if name != "articulated" else (-front * 0.6, -0.2, front * 0.65)
    return [
        *parts,
        block((0, 0, floor + 0.35), (length * 0.92, half * 2.01, 0.22), CARGO),
        twin_blocks((front - 0.02, half * 0.75, 0.75), (0.08, 0.4, 0.2), HEADLAMP),
        twin_blocks((-front, half * 0.82, 1.0), (0.06, 0.22, 0.4), TAIL_LAMP),
        axles(positions, half + 0.02 - 0.16, 0.46, 0.3),
    ]


def _bus_windows(start: float, end: float, z: float, height: float, half: float) -> list[Mesh]:
    count = max(int((end - start) / 1.4), 2)
    width, size = (end - start) / count, ((end - start) / count - 0.14, half * 1.985, height)
    return [block((start + (k + 0.5) * width, 0, z), size, GLASS) for k in range(count)]
