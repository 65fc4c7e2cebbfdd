"""Actors: everything that is annotated, with its state at any time of the drive."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.transforms import Array
from bevcli.synth.assets.catalog import Variant
from bevcli.synth.assets.paint import linear
from bevcli.synth.world.traffic import Unit, Vehicle, points_between

MOVING_M_S = 0.3  # slower counts as standing
_DIFFERENCE_S = 0.02  # velocities are central differences over twice this


@dataclass(frozen=True)
class Body:
    """How an actor looks: its variant stretched to a size, in its colours."""

    variant: Variant
    size_lwh: Array
    paint: NDArray[np.float32]
    dye: NDArray[np.float32]
    instance: str


@dataclass(frozen=True)
class State:
    """An actor at a time. position: (3,) world, the middle of its bottom. velocity: (2,) world, m/s."""

    body: Body
    position: Array
    yaw: float
    velocity: Array
    attribute: str
    pose: int = 0


class Actor(Protocol):
    """Something with a state over time; None while it is not there."""

    def state(self, time_s: float) -> State | None:
        """The state at a time in seconds since the drive's start."""
        ...


def draw_body(
    variant: Variant, rng: np.random.Generator, instance: str, spread: float = 0.05, tall: float = 1.0
) -> Body:
    """A body of a variant: its size varied by `spread`, its colours drawn."""
    size = variant.size_lwh * rng.uniform(1 - spread, 1 + spread, 3) * tall
    paint = variant.paints[int(rng.integers(len(variant.paints)))]
    dye = variant.dyes[int(rng.integers(len(variant.dyes)))]
    return Body(variant, size, linear(paint), linear(dye), instance)


@dataclass(frozen=True)
class Standing:
    """An actor that never moves."""

    body: Body
    position: Array
    yaw: float
    attribute: str

    def state(self, time_s: float) -> State:
        """Always the same state."""
        return State(self.body, self.position, self.yaw, np.zeros(2), self.attribute)


@dataclass(frozen=True)
class Driving:
    """One body of a vehicle that follows its track: its axles stand on the route."""

    vehicle: Vehicle
    unit: Unit
    times: NDArray[np.float64]
    fronts: NDArray[np.float64]
    speeds: NDArray[np.float64]

    @staticmethod
    def of(vehicle: Vehicle) -> list[Driving]:
        """The bodies of a vehicle whose track is complete."""
        times, fronts, speeds = np.array(vehicle.track).T
        return [Driving(vehicle, unit, times, fronts, speeds) for unit in vehicle.units]

    def state(self, time_s: float) -> State | None:
        """None before it appeared and after it left."""
        if time_s < self.times[0] or time_s > self.times[-1]:
            return None
        center, yaw = self._pose(time_s)
        early, late = max(time_s - _DIFFERENCE_S, self.times[0]), min(time_s + _DIFFERENCE_S, self.times[-1])
        velocity = (self._pose(late)[0] - self._pose(early)[0]) / max(late - early, 1e-9)
        body = Body(self.unit.variant, self.unit.size_lwh, self.unit.paint, self.unit.dye, self.unit.instance)
        position = np.array([center[0], center[1], 0.0])
        moving = float(np.hypot(*velocity)) > MOVING_M_S
        return State(body, position, yaw, velocity, driving_attribute(body.variant, moving))

    def _pose(self, time_s: float) -> tuple[Array, float]:
        front = interpolated_track(self.times, self.fronts, self.speeds, time_s)
        length = float(self.unit.size_lwh[0])
        middle = front - self.unit.lag - length / 2
        route = self.vehicle.route
        rear, fore = points_between(route.points, route.positions, middle - 0.3 * length, middle + 0.3 * length, 2)
        return (rear + fore) / 2, math.atan2(fore[1] - rear[1], fore[0] - rear[0])


def interpolated_track(times: Array, fronts: Array, speeds: Array, time_s: float) -> float:
    """Position on a track at a time: a cubic between steps that keeps positions and speeds."""
    k = min(max(int(times.searchsorted(time_s, side="right")) - 1, 0), len(times) - 2)
    span = times[k + 1] - times[k]
    u = (time_s - times[k]) / span
    a, b, m, n = fronts[k], fronts[k + 1], speeds[k] * span, speeds[k + 1] * span
    return float(
        (2 * u**3 - 3 * u**2 + 1) * a + (u**3 - 2 * u**2 + u) * m + (3 * u**2 - 2 * u**3) * b + (u**3 - u**2) * n
    )


def driving_attribute(variant: Variant, moving: bool) -> str:
    """nuScenes' attribute of something on a route."""
    if variant.class_name in ("bicycle", "motorcycle"):
        return "cycle.with_rider" if variant.name.endswith("_rider") else "cycle.without_rider"
    return "vehicle.moving" if moving else "vehicle.stopped"
