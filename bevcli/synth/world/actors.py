"""Actors: the annotated objects, with their state at any time of the drive."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.transforms import Array
from bevcli.synth.assets.catalog import Body, Variant
from bevcli.synth.world.traffic import Unit, Vehicle, points_between

MOVING_M_S = 0.3  # slower actors have the attribute of a standing one
_DIFFERENCE_S = 0.02  # half the interval of the central differences that give velocities


@dataclass(frozen=True)
class ActorState:
    """An actor at one time.

    Attributes:
        body: size and looks.
        position: (3,) middle of the bottom, world, metres.
        yaw: world, radians.
        velocity: (2,) world, m/s.
        attribute: nuScenes attribute, such as "vehicle.moving"; empty for classes without attributes.
        pose: index of the mesh among the variant's poses; taken modulo their number.
    """

    body: Body
    position: Array
    yaw: float
    velocity: Array
    attribute: str
    pose: int = 0


class Actor(Protocol):
    """An annotated object over the time of a drive."""

    def state(self, time_s: float) -> ActorState | None:
        """The state at a time in seconds since the start of the drive, or None while it is not there."""
        ...


@dataclass(frozen=True)
class StandingActor:
    """An actor that never moves.

    Attributes:
        body: size and looks.
        position: (3,) middle of the bottom, world, metres.
        yaw: world, radians.
        attribute: nuScenes attribute.
    """

    body: Body
    position: Array
    yaw: float
    attribute: str

    def state(self, time_s: float) -> ActorState:
        """The same state at all times."""
        return ActorState(self.body, self.position, self.yaw, np.zeros(2), self.attribute)


@dataclass(frozen=True)
class DrivingActor:
    """One unit of a driving vehicle. Its axles are on the route.

    Attributes:
        vehicle: the vehicle, after the simulation.
        unit: the unit.
        times: (T,) times of the simulation steps, seconds.
        fronts: (T,) route positions of the vehicle's front, metres.
        speeds: (T,) m/s.
    """

    vehicle: Vehicle
    unit: Unit
    times: NDArray[np.float64]
    fronts: NDArray[np.float64]
    speeds: NDArray[np.float64]

    @staticmethod
    def of(vehicle: Vehicle) -> list[DrivingActor]:
        """One actor for each unit of a vehicle. Call it after the simulation."""
        times, fronts, speeds = np.array(vehicle.track).T
        return [DrivingActor(vehicle, unit, times, fronts, speeds) for unit in vehicle.units]

    def state(self, time_s: float) -> ActorState | None:
        """The state, or None before the vehicle appears and after it leaves."""
        if time_s < self.times[0] or time_s > self.times[-1]:
            return None
        center, yaw = self._pose(time_s)
        early, late = max(time_s - _DIFFERENCE_S, self.times[0]), min(time_s + _DIFFERENCE_S, self.times[-1])
        velocity = (self._pose(late)[0] - self._pose(early)[0]) / max(late - early, 1e-9)
        body = self.unit.body
        position = np.array([center[0], center[1], 0.0])
        moving = float(np.hypot(*velocity)) > MOVING_M_S
        return ActorState(body, position, yaw, velocity, driving_attribute(body.variant, moving))

    def _pose(self, time_s: float) -> tuple[Array, float]:
        front = interpolated_track(self.times, self.fronts, self.speeds, time_s)
        length = float(self.unit.body.size_lwh[0])
        middle = front - self.unit.lag - length / 2
        route = self.vehicle.route
        rear, fore = points_between(route.points, route.positions, middle - 0.3 * length, middle + 0.3 * length, 2)
        return (rear + fore) / 2, math.atan2(fore[1] - rear[1], fore[0] - rear[0])


def interpolated_track(times: Array, fronts: Array, speeds: Array, time_s: float) -> float:
    """Route position in metres at a time: cubic Hermite interpolation between the steps of a track.

    times, fronts, speeds: (T,) seconds, metres and m/s of the steps.
    """
    k = min(max(int(times.searchsorted(time_s, side="right")) - 1, 0), len(times) - 2)
    span = times[k + 1] - times[k]
    u = (time_s - times[k]) / span
    a, b, m, n = fronts[k], fronts[k + 1], speeds[k] * span, speeds[k + 1] * span
    return float(
        (2 * u**3 - 3 * u**2 + 1) * a + (u**3 - 2 * u**2 + u) * m + (3 * u**2 - 2 * u**3) * b + (u**3 - u**2) * n
    )


def driving_attribute(variant: Variant, moving: bool) -> str:
    """The nuScenes attribute of a vehicle or cycle in traffic."""
    if variant.class_name in ("bicycle", "motorcycle"):
        return "cycle.with_rider" if variant.name.endswith("_rider") else "cycle.without_rider"
    return "vehicle.moving" if moving else "vehicle.stopped"
