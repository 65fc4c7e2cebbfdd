"""The catalog of annotated objects: the variants of each class, and a drawn individual of a variant."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bevcli.synth.assets.buses import BUS_NAMES, bus
from bevcli.synth.assets.cars import CAR_SHAPES, car
from bevcli.synth.assets.cycles import BICYCLE_NAMES, MOTORCYCLE_NAMES, bicycle, motorcycle
from bevcli.synth.assets.machines import MACHINE_NAMES, machine
from bevcli.synth.assets.mesh import Mesh
from bevcli.synth.assets.paint import (
    BUS_PAINTS,
    CAR_PAINTS,
    CLOTHES,
    MACHINE_PAINTS,
    TRUCK_PAINTS,
    Color,
    linear,
)
from bevcli.synth.assets.people import PERSON_NAMES, person
from bevcli.synth.assets.roadworks import BARRIER_NAMES, CONE_NAMES, barrier, traffic_cone
from bevcli.synth.assets.street_furniture import StreetFurniture
from bevcli.synth.assets.trailers import TRAILER_NAMES, trailer
from bevcli.synth.assets.trucks import TRUCK_NAMES, truck

YELLOW_ONLY: tuple[Color, ...] = ((238, 190, 30),)  # paint of taxis and school buses


@dataclass(frozen=True)
class Variant:
    """One look of a class.

    Attributes:
        class_name: one of the ten nuScenes classes.
        name: the look, such as "sedan" or "city_rider"; unique within the class.
        poses: meshes of one size, shown in turn while the object moves.
        size_lwh: (3,) usual length, width and height, metres.
        paints: colours to draw from for PAINT faces.
        dyes: colours to draw from for DYE faces.
    """

    class_name: str
    name: str
    poses: tuple[Mesh, ...]
    size_lwh: NDArray[np.float64]
    paints: tuple[Color, ...]
    dyes: tuple[Color, ...]


@dataclass(frozen=True)
class Body:
    """An individual of a variant, with its own size and colours.

    Attributes:
        variant: the look.
        size_lwh: (3,) length, width and height, metres; the mesh is stretched to it.
        paint: (3,) linear RGB of PAINT faces.
        dye: (3,) linear RGB of DYE faces.
        instance: the ground truth instance name, unique in a drive.
    """

    variant: Variant
    size_lwh: NDArray[np.float64]
    paint: NDArray[np.float32]
    dye: NDArray[np.float32]
    instance: str


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


class Catalog:
    """All variants by class. It does not depend on the drive."""

    def __init__(self) -> None:
        self.by_class: dict[str, tuple[Variant, ...]] = {
            "car": _variants("car", CAR_SHAPES, car, CAR_PAINTS, CAR_PAINTS),
            "truck": _variants("truck", TRUCK_NAMES, truck, TRUCK_PAINTS, TRUCK_PAINTS),
            "construction_vehicle": _variants(
                "construction_vehicle", MACHINE_NAMES, machine, MACHINE_PAINTS, TRUCK_PAINTS
            ),
            "bus": _variants("bus", BUS_NAMES, bus, BUS_PAINTS, BUS_PAINTS),
            "trailer": _variants("trailer", TRAILER_NAMES, trailer, TRUCK_PAINTS, TRUCK_PAINTS),
            "barrier": _variants("barrier", BARRIER_NAMES, barrier, CAR_PAINTS, CLOTHES),
            "motorcycle": _variants("motorcycle", MOTORCYCLE_NAMES, motorcycle, CAR_PAINTS, CLOTHES),
            "bicycle": _variants("bicycle", BICYCLE_NAMES, bicycle, CAR_PAINTS, CLOTHES),
            "pedestrian": (*map(_walking_person, PERSON_NAMES), *map(_standing_person, PERSON_NAMES)),
            "traffic_cone": _variants("traffic_cone", CONE_NAMES, traffic_cone, CAR_PAINTS, CLOTHES),
        }

    def draw(self, class_name: str, rng: np.random.Generator, names: Iterable[str] | None = None) -> Variant:
        """Draw a variant of a class. names: draw from these variants only."""
        allowed = None if names is None else set(names)
        choices = [v for v in self.by_class[class_name] if allowed is None or v.name in allowed]
        return choices[int(rng.integers(len(choices)))]


@dataclass(frozen=True)
class Assets:
    """The meshes that all drives share. Build them once and pass them to every drive.

    Attributes:
        catalog: the annotated objects.
        furniture: the repeated objects without annotations.
    """

    catalog: Catalog
    furniture: StreetFurniture

    @staticmethod
    def build() -> Assets:
        """Build every mesh. This takes about half a second."""
        return Assets(Catalog(), StreetFurniture())


def _variants(
    class_name: str,
    names: Iterable[str],
    make: Callable[[str], Mesh],
    paints: tuple[Color, ...],
    dyes: tuple[Color, ...],
) -> tuple[Variant, ...]:
    variants = []
    for name in names:
        mesh = make(name)
        chosen = YELLOW_ONLY if name in ("taxi", "school") else paints
        variants.append(Variant(class_name, name, (mesh,), mesh.extents, chosen, dyes))
    return tuple(variants)


def _walking_person(name: str) -> Variant:
    """A variant with two mirrored strides of the same size."""
    poses = (person(name, 1), person(name, -1))
    return Variant("pedestrian", name, poses, poses[0].extents * _height_factor(name), CLOTHES, CLOTHES)


def _standing_person(name: str) -> Variant:
    pose = person(name, 0)
    size = pose.extents * _height_factor(name)
    return Variant("pedestrian", f"{name}_standing", (pose,), size, CLOTHES, CLOTHES)


def _height_factor(name: str) -> float:
    return 0.68 if name == "child" else 1.0
