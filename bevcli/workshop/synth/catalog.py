"""The catalog of annotated objects: the variants of each class, and a drawn individual of a variant."""

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bevcli.workshop.synth import people, street_objects, vehicles
from bevcli.workshop.synth.mesh import Color, Mesh, joined, linear, made
from bevcli.workshop.synth.people import CYCLES, RIDDEN
from bevcli.workshop.synth.street_objects import MACHINES, StreetFurniture

# Colours to draw from.
CAR_PAINTS: tuple[Color, ...] = (
    (235, 236, 238), (196, 199, 203), (120, 124, 130), (62, 66, 72), (26, 28, 32), (170, 28, 30), (120, 22, 30),
    (28, 60, 128), (52, 108, 176), (22, 40, 70), (34, 84, 62), (214, 178, 40), (204, 98, 32), (150, 132, 104),
    (108, 80, 58), (92, 132, 142),
)  # fmt: skip
TRUCK_PAINTS: tuple[Color, ...] = (
    (238, 238, 236), (228, 228, 224), (196, 40, 34), (30, 84, 160), (226, 168, 30), (44, 112, 72), (104, 108, 112),
    (232, 120, 36),
)  # fmt: skip
BUS_PAINTS: tuple[Color, ...] = (
    (224, 60, 44), (36, 98, 176), (240, 190, 40), (240, 240, 236), (48, 140, 92), (128, 52, 120), (52, 168, 178),
)  # fmt: skip
MACHINE_PAINTS: tuple[Color, ...] = ((236, 176, 24), (232, 140, 20), (222, 92, 28), (236, 200, 60), (188, 190, 60))
CLOTHES: tuple[Color, ...] = (
    (40, 42, 48), (70, 76, 88), (132, 136, 142), (204, 202, 196), (150, 40, 44), (40, 70, 130), (78, 112, 160),
    (58, 96, 70), (188, 148, 60), (120, 72, 110), (196, 112, 92), (96, 76, 60),
)  # fmt: skip
OWN_PAINTS: dict[str, tuple[Color, ...]] = dict.fromkeys(("taxi", "school"), ((238, 190, 30),))  # by look


@dataclass(frozen=True)
class Variant:
    """One look of a class."""

    class_name: str  # one of the ten nuScenes classes
    name: str  # the look, such as "sedan" or "city_rider"; unique within the class
    poses: tuple[Mesh, ...]  # meshes of one size, shown in turn while the object moves
    size_lwh: NDArray[np.float64]  # (3,) usual length, width and height, metres
    paints: tuple[Color, ...]  # colours to draw from for PAINT faces
    dyes: tuple[Color, ...]  # colours to draw from for DYE faces


@dataclass(frozen=True, eq=False)
class Body:
    """An individual of a variant, with its own size and colours."""

    variant: Variant  # the look
    size_lwh: NDArray[np.float64]  # (3,) length, width and height, metres; the mesh is stretched to it
    paint: NDArray[np.float32]  # (3,) linear RGB of PAINT faces
    dye: NDArray[np.float32]  # (3,) linear RGB of DYE faces
    instance: str  # the ground truth instance name, unique in a drive


def draw_body(
    variant: Variant, rng: np.random.Generator, instance: str, spread: float = 0.05, scale: float = 1.0
) -> Body:
    """Draw an individual of a variant.

    spread: each dimension is drawn from 1 - spread to 1 + spread times the usual one. scale: factor on all dimensions.
    """
    size = variant.size_lwh * rng.uniform(1 - spread, 1 + spread, 3) * scale
    paint = variant.paints[int(rng.integers(len(variant.paints)))]
    dye = variant.dyes[int(rng.integers(len(variant.dyes)))]
    return Body(variant, size, linear(paint), linear(dye), instance)


# The classes but pedestrians: the names of the looks, the function that makes their parts, paints, dyes.
_CLASSES: dict[str, tuple[Iterable[str], Callable[[str], list[Mesh]], tuple[Color, ...], tuple[Color, ...]]] = {
    "car": (vehicles.CAR_SHAPES, vehicles.car, CAR_PAINTS, CAR_PAINTS),
    "truck": (vehicles.TRUCK_NAMES, vehicles.truck, TRUCK_PAINTS, TRUCK_PAINTS),
    "construction_vehicle": (MACHINES, lambda look: made(MACHINES[look]), MACHINE_PAINTS, TRUCK_PAINTS),
    "bus": (vehicles.BUSES, vehicles.bus, BUS_PAINTS, BUS_PAINTS),
    "trailer": (vehicles.TRAILER_NAMES, vehicles.trailer, TRUCK_PAINTS, TRUCK_PAINTS),
    "barrier": (street_objects.BARRIER_NAMES, street_objects.barrier, CAR_PAINTS, CLOTHES),
    "motorcycle": (CYCLES["motorcycle"] + RIDDEN["motorcycle"], people.motorcycle, CAR_PAINTS, CLOTHES),
    "bicycle": (CYCLES["bicycle"] + RIDDEN["bicycle"], people.bicycle, CAR_PAINTS, CLOTHES),
    "traffic_cone": (street_objects.CONE_NAMES, street_objects.traffic_cone, CAR_PAINTS, CLOTHES),
}


@dataclass(frozen=True)
class Assets:
    """The meshes that all drives share. Build them once and pass them to every drive."""

    by_class: Mapping[str, tuple[Variant, ...]]  # all variants of the annotated objects, by class
    furniture: StreetFurniture  # the repeated objects without annotations

    @staticmethod
    def build() -> "Assets":
        """Build every mesh. This takes about half a second."""
        by_class: dict[str, tuple[Variant, ...]] = {}
        for name, (looks, make, paints, dyes) in _CLASSES.items():
            meshes = {look: joined(make(look)) for look in looks}
            by_class[name] = tuple(
                Variant(name, look, (mesh,), mesh.extents, OWN_PAINTS.get(look, paints), dyes)
                for look, mesh in meshes.items()
            )
        # A walking person has two mirrored strides of the same size.
        walking, standing = ([_person(name, *strides) for name in people.PERSON_NAMES] for strides in ((1, -1), (0,)))
        return Assets({**by_class, "pedestrian": (*walking, *standing)}, StreetFurniture())

    def draw(self, class_name: str, rng: np.random.Generator, names: Collection[str] | None = None) -> Variant:
        """Draw a variant of a class. names: draw from these variants only."""
        choices = [v for v in self.by_class[class_name] if names is None or v.name in names]
        return choices[int(rng.integers(len(choices)))]


def _person(name: str, *strides: int) -> Variant:
    poses = tuple(joined(people.person(name, stride)) for stride in strides)
    size = poses[0].extents * (0.68 if name == "child" else 1.0)
    return Variant("pedestrian", name if any(strides) else f"{name}_standing", poses, size, CLOTHES, CLOTHES)
