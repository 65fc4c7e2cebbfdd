"""The CAN bus expansion of nuScenes: what the vehicle's sensors said, per scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bevcli.geometry.ego_motion import Kinematics
from bevcli.geometry.transforms import Array
from bevcli.sequences.nuscenes.json_tables import integers, read_rows, vectors


@dataclass(frozen=True)
class CanBus:
    """The pose messages of a scene: times_us (T,), and accelerations, angular_rates, velocities (T, 3), ego frame."""

    times_us: NDArray[np.int64]
    accelerations: Array
    angular_rates: Array
    velocities: Array

    def kinematics_at(self, time_us: int) -> Kinematics:
        """The first message after a time (the last one, where none is), as the published models were trained with."""
        row = min(int(np.searchsorted(self.times_us, time_us, side="right")), len(self.times_us) - 1)
        return Kinematics(self.accelerations[row], self.angular_rates[row], self.velocities[row])


def read_can_bus(root: Path, scene: str) -> CanBus | None:
    """A scene's messages; None where the expansion, or this scene in it, is missing. Raises InputError."""
    path = root / "can_bus" / f"{scene}_pose.json"
    if not path.is_file():
        return None
    rows = read_rows(path)
    if not rows:
        return None
    times = integers(rows, "utime", path)
    quantities = [vectors(rows, name, path, 3) for name in ("accel", "rotation_rate", "vel")]
    order = np.argsort(times, kind="stable")
    return CanBus(times[order], *(values[order] for values in quantities))
