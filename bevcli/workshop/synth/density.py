"""Numbers of road users in a drive, and their mixture."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

TRAFFIC = {
    "car": 0.54, "truck": 0.12, "bus": 0.09, "train": 0.09, "motorcycle": 0.10, "construction_vehicle": 0.06,
}  # fmt: skip
PARKED = {"car": 0.78, "truck": 0.09, "trailer": 0.05, "motorcycle": 0.05, "bus": 0.03}


@dataclass(frozen=True)
class Density:
    """Numbers of road users, and their mixture."""

    vehicles: int = 22  # around the ego vehicle, which counts as a vehicle
    bicycles: int = 6  # that drive around the ego vehicle
    traffic: Mapping[str, float] = field(default_factory=lambda: TRAFFIC)  # class of driving vehicles -> share
    parked: Mapping[str, float] = field(default_factory=lambda: PARKED)  # class -> share
    filled: float = 0.55  # share of parking spaces that are taken
    works: float = 0.27  # share of parking lanes (one side of a stretch) with road works
    strollers: float = 4.5  # mean number for each block
    crosser_s: float = 8.0  # mean time between people who cross at a junction, seconds


def draw_density(rng: np.random.Generator) -> Density:
    """A density from that of the default to a crowded street, with a larger share of cars."""
    return Density(
        int(rng.integers(20, 60)),
        int(rng.integers(3, 9)),
        _with_cars(TRAFFIC, float(rng.uniform(0.55, 0.85))),
        _with_cars(PARKED, float(rng.uniform(0.72, 0.93))),
        float(rng.uniform(0.5, 1.0)),
        float(rng.choice([0.27, 0.1])),
        float(rng.uniform(3, 9)),
        float(rng.uniform(4, 10)),
    )


def _with_cars(mix: Mapping[str, float], cars: float) -> dict[str, float]:
    """The mixture with another share of cars; the others keep their proportions."""
    return {name: cars if name == "car" else share * (1 - cars) / (1 - mix["car"]) for name, share in mix.items()}
