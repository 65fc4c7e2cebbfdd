"""The motion of the ego vehicle's body on its springs: pitch, roll and heave over the time of a drive.

The body nods under acceleration and leans out of curves, with the swing of a damped spring. The road is uneven: short
waves, and long ones as of slopes and crowns, which tilt the vehicle for a stretch of the flat world. A load tilts it
for the whole drive. Real drives do as much: in nuScenes' scene-0103 the pitch changes by 0.9 degrees within 0.5 s.
"""

from dataclasses import dataclass

import numpy as np
from scipy.signal import lsim

from bevcli.geometry.transforms import Array, rigid
from bevcli.workshop.synth.rig import tilt
from bevcli.workshop.synth.traffic import EgoTrack

MOST_DEG = (1.5, 1.0)  # pitch and roll
MOST_HEAVE_M = 0.03
MIDDLE = np.array([1.4, 0.0, 0.0])  # of the turn, in the ego frame, metres
STEP_S = 0.01
SPRING_HZ, DAMPING = 1.3, 0.35
NOD_DEG, LEAN_DEG = (0.12, 0.30), (0.15, 0.35)  # of pitch and roll for each m/s², lowest and highest of the vehicles
LOAD_DEG = (0.4, 0.25)  # standard deviations
WAVES_M = (5, 200, 12)  # shortest and longest wave of the road, and their number
SHORT_M = 25.0  # waves that are shorter come of an uneven road, longer ones of its slopes and crowns
UNEVEN_DEG, SLOPE_DEG = 0.1, 0.2  # standard deviations of each wave
UNEVEN_M = 0.004  # the same of the heave


@dataclass(frozen=True)
class BodyMotion:
    """Tilt and heave of the body at times after the start of a drive, over a vehicle that stands on a level road."""

    times: Array  # (T,) seconds
    turns: Array  # (T, 2) pitch, positive with the nose down, and roll, positive with the right side down; radians
    heaves: Array  # (T,) metres

    @staticmethod
    def draw(ego: EgoTrack, random: np.random.Generator) -> "BodyMotion":
        """The motion of a vehicle on its way, with springs, a load and a road that are drawn at random."""
        times = np.arange(ego.track[0, 0], ego.track[0, -1], STEP_S)
        way, speeds = (np.interp(times, ego.track[0], row) for row in ego.track[1:])
        gains = [random.uniform(*range_deg) for range_deg in (NOD_DEG, LEAN_DEG)]
        forward, left = np.gradient(speeds, STEP_S), speeds * np.gradient(ego.route.yaw_at(way), STEP_S)
        own = 2 * np.pi * SPRING_HZ
        spring = ([own**2], [1, 2 * DAMPING * own, own**2])
        swings = [lsim(spring, pull, times - times[0])[1] for pull in (-gains[0] * forward, gains[1] * left)]
        lengths, roughness = np.geomspace(*WAVES_M), random.uniform(0.3, 1.3)
        waves = np.sin(2 * np.pi * (way[:, None, None] / lengths + random.random((3, len(lengths)))))  # (T, 3, waves)
        heights_deg = np.sqrt(2) * roughness * np.where(lengths < SHORT_M, UNEVEN_DEG, SLOPE_DEG)
        turns_deg = np.stack(swings, -1) + random.normal(0, LOAD_DEG) + waves[:, :2] @ heights_deg
        turns = np.radians(MOST_DEG * np.tanh(turns_deg / MOST_DEG))
        heaves = waves[:, 2] @ np.full(len(lengths), UNEVEN_M * roughness)
        return BodyMotion(times, turns, MOST_HEAVE_M * np.tanh(heaves / MOST_HEAVE_M))

    def level_from_body(self, time_s: float) -> Array:
        """(4, 4) from the ego frame to that of the vehicle on a level road with its springs at rest, metres."""
        pitch, roll, heave = (np.interp(time_s, self.times, x) for x in (*self.turns.T, self.heaves))
        turn = tilt(pitch, roll)
        return rigid(MIDDLE + (0, 0, heave)) @ rigid(-turn @ MIDDLE, turn)
