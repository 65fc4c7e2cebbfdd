"""A drive with turns, as its poses are stated and as its images show it, and planted mistakes in the poses."""

from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from bevcli.geometry.ego_motion import EgoMotion
from bevcli.workshop.odometry.measure import MeasuredMotion, MeasuredStep

START_NS, PERIOD_NS = 1_700_000_000_000_000_000, 20_000_000
FIRST, FRAMES, EVERY = 500, 9, 25  # rows of the drive: those of nine frames, twice a second
DEVIATIONS = np.array([np.radians(0.05)] * 2 + [np.radians(0.02)] + [0.01, 0.01, 0.02])


def about_z(yaws):
    return Rotation.from_rotvec(np.multiply.outer(yaws, (0, 0, 1)))


def motion_of(times_ns, positions, rotations):
    quaternions = np.roll(rotations.as_quat(), 1, axis=1)
    return EgoMotion(times_ns, positions, quaternions, *np.zeros((3, len(positions), 3)))


def planar(positions, yaws, times_ns):
    return motion_of(times_ns, positions, about_z(yaws))


def drive(turning=1.0, changing=1.0, seed=0):
    """Times, positions and yaws of a drive of 30 s at 50 Hz that turns and changes its speed."""
    random = np.random.default_rng(seed)
    seconds = np.arange(1500) * PERIOD_NS / 1e9
    phases = random.uniform(0, 6, 4)
    speeds = 7 + changing * (2.5 * np.sin(0.9 * seconds + phases[0]) + np.sin(2.3 * seconds + phases[1]))
    rates = turning * (0.25 * np.sin(0.7 * seconds + phases[2]) + 0.15 * np.sin(1.9 * seconds + phases[3]))
    yaws = 0.7 + np.cumsum(rates) * PERIOD_NS / 1e9
    steps = speeds[:, None] * np.column_stack([np.cos(yaws), np.sin(yaws), 0 * yaws]) * PERIOD_NS / 1e9
    return START_NS + np.arange(1500) * PERIOD_NS, np.cumsum(steps, axis=0) + (600, 1600, 0), yaws


def measured(times_ns, positions, yaws, seed=0, deviations=DEVIATIONS, reason=""):
    """The motion that the images show: the true one with noise."""
    random, rows = np.random.default_rng(seed), FIRST + EVERY * np.arange(FRAMES)
    steps = []
    for a, b in pairwise(rows):
        noise = deviations * random.standard_normal(6)
        step = np.eye(4)
        step[:3, :3] = (Rotation.from_rotvec(noise[:3]) * about_z(yaws[b] - yaws[a])).as_matrix()
        step[:3, 3] = about_z(-yaws[a]).apply(positions[b] - positions[a]) + noise[3:]
        steps.append(MeasuredStep(step, np.diag(deviations**2), reason))
    return MeasuredMotion("drive", times_ns[rows], tuple(steps))


TIMES, POSITIONS, YAWS = drive()
SHOWN = measured(TIMES, POSITIONS, YAWS)


def stated(positions=POSITIONS, yaws=YAWS, times_ns=TIMES):
    return planar(positions, yaws, times_ns)


def turned(degrees):
    """The vehicle frame turned to the left."""
    return stated(yaws=YAWS + np.radians(degrees))


def antenna(point):
    return stated(POSITIONS + about_z(YAWS).apply(point))


def jumping(row=FIRST + 4 * EVERY, size=3.0):
    positions = POSITIONS.copy()
    positions[row:] += (size, 0, 0)
    return stated(positions)


MISTAKES = {
    "km/h": (stated(3.6 * POSITIONS), "motion-scale", "km/h were taken for m/s", "3.6"),
    "mph": (stated(2.23694 * POSITIONS), "motion-scale", "mph were taken for m/s", "2.2"),
    "millimetres": (stated(1000 * POSITIONS), "motion-scale", "in millimetres", " ± "),
    "kilometres": (stated(POSITIONS / 1000), "motion-scale", "in kilometres", "0.001"),
    "wheel": (stated(1.08 * POSITIONS), "motion-scale", "another scale", "1.08 ±"),
    "x right": (turned(-90), "motion-axes", "x of the poses is not forward", "x points 90."),
    "a little turned": (turned(-6), "motion-axes", "x of the poses is not forward", "x points 6."),
    "late": (stated(times_ns=TIMES + 180_000_000), "motion-time", "another time", "ms too late"),
    "early": (stated(times_ns=TIMES - 70_000_000), "motion-time", "another time", "ms too early"),
    "seconds late": (stated(times_ns=TIMES + 5_000_000_000), "motion-time", "another time", "s too late"),
    "backwards": (stated(POSITIONS[::-1], YAWS[::-1]), "motion-reversed", "backwards in time", ""),
    "antenna": (antenna((2.4, 0, 0)), "motion-origin", "another point of the vehicle", "x +2."),
    "another drive": (stated(*drive(seed=5)[1:]), "motion-wrong-drive", "do not fit the images", "of 8 steps"),
    "standing": (stated(0 * POSITIONS, 0 * YAWS), "motion-stands", "the poses stand still", "0.0 m in the poses"),
    "jump": (jumping(), "motion-jumps", "the poses jump", "between frames 3 and 4; 3.0 m"),
}  # fmt: skip
