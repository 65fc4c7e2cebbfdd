"""The catalog of everything that is annotated: class -> variants with their usual sizes."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bevcli.synth.assets import paint as palette
from bevcli.synth.assets.buses import BUS_NAMES, bus
from bevcli.synth.assets.cars import CAR_SHAPES, car
from bevcli.synth.assets.cycles import BICYCLE_NAMES, MOTORCYCLE_NAMES, bicycle, motorcycle
from bevcli.synth.assets.machines import MACHINE_NAMES, machine
from bevcli.synth.assets.mesh import Mesh
from bevcli.synth.assets.paint import Color
from bevcli.synth.assets.people import PERSON_NAMES, person
from bevcli.synth.assets.roadworks import BARRIER_NAMES, CONE_NAMES, barrier, traffic_cone
from bevcli.synth.assets.trailers import TRAILER_NAMES, trailer
from bevcli.synth.assets.trucks import TRUCK_NAMES, truck


@dataclass(frozen=True)
class Variant:
    """One look of a class. poses: meshes of the same size to alternate between while it moves.

    size_lwh: (3,) usual size in metres. paints, dyes: colours to choose from.
    """

    class_name: str
    name: str
    poses: tuple[Mesh, ...]
    size_lwh: NDArray[np.float64]
    paints: tuple[Color, ...]
    dyes: tuple[Color, ...]


class Catalog:
    """All variants by class, built once; it holds no state of any drive."""

    def __init__(self) -> None:
        p = palette
        self.by_class: dict[str, tuple[Variant, ...]] = {
            "car": _variants("car", CAR_SHAPES, car, p.CAR_PAINTS, p.CAR_PAINTS),
            "truck": _variants("truck", TRUCK_NAMES, truck, p.TRUCK_PAINTS, p.TRUCK_PAINTS),
            "construction_vehicle": _variants(
                "construction_vehicle", MACHINE_NAMES, machine, p.MACHINE_PAINTS, p.TRUCK_PAINTS
            ),
            "bus": _variants("bus", BUS_NAMES, bus, p.BUS_PAINTS, p.BUS_PAINTS),
            "trailer": _variants("trailer", TRAILER_NAMES, trailer, p.TRUCK_PAINTS, p.TRUCK_PAINTS),
            "barrier": _variants("barrier", BARRIER_NAMES, barrier, p.CAR_PAINTS, p.CLOTHES),
            "motorcycle": _variants("motorcycle", MOTORCYCLE_NAMES, motorcycle, p.CAR_PAINTS, p.CLOTHES),
            "bicycle": _variants("bicycle", BICYCLE_NAMES, bicycle, p.CAR_PAINTS, p.CLOTHES),
            "pedestrian": (*map(_walker, PERSON_NAMES), *map(_stander, PERSON_NAMES)),
            "traffic_cone": _variants("traffic_cone", CONE_NAMES, traffic_cone, p.CAR_PAINTS, p.CLOTHES),
        }

    def draw(self, class_name: str, rng: np.random.Generator, names: Iterable[str] | None = None) -> Variant:
        """A variant of a class, from `names` only where they are given."""
        allowed = None if names is None else set(names)
        choices = [v for v in self.by_class[class_name] if allowed is None or v.name in allowed]
        return choices[int(rng.integers(len(choices)))]


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
        chosen = ((238, 190, 30),) if name in ("taxi", "school") else paints
        variants.append(Variant(class_name, name, (mesh,), mesh.extents, chosen, dyes))
    return tuple(variants)


def _walker(name: str) -> Variant:
    """Two mirrored strides that fill the same box."""
    poses = (person(name, 1), person(name, -1))
    return Variant("pedestrian", name, poses, poses[0].extents * _stature(name), palette.CLOTHES, palette.CLOTHES)


def _stander(name: str) -> Variant:
    pose = person(name, 0)
    size = pose.extents * _stature(name)
    return Variant("pedestrian", f"{name}_standing", (pose,), size, palette.CLOTHES, palette.CLOTHES)


def _stature(name: str) -> float:
    return 0.68 if name == "child" else 1.0
