"""The motion that a drive states, as if it had been measured: for tests of what uses a measured motion."""

import shutil
from itertools import pairwise
from pathlib import Path

import numpy as np

from bevcli.geometry.transforms import inverse
from bevcli.workshop.odometry.measure import MeasuredMotion, MeasuredStep

STREET = Path(__file__).parents[2] / "samples/street"
DEVIATIONS = np.array([np.radians(0.02)] * 3 + [0.01] * 3)


def motion_of(drive, guessed=(), scale=1.0):
    """The motion of the poses of a drive. guessed: steps that are said not to be measured. scale: of its lengths."""
    poses = [drive.load(place).world_from_ego.matrix for place in range(len(drive.stamps))]
    steps = []
    for index, (a, b) in enumerate(pairwise(poses)):
        step = inverse(a) @ b
        step[:3, 3] *= scale
        reason = "too dark" if index in guessed else ""
        wide = 20 if reason else 1
        steps.append(MeasuredStep(step, np.diag((wide * DEVIATIONS) ** 2), reason, 0 if reason else 200, 50))
    times = np.array([stamp.timestamp_ns for stamp in drive.stamps], dtype=np.int64)
    return MeasuredMotion(drive.name, times, tuple(steps))


def street_copy(folder, frames):
    """The first frames of the sample drive, without its poses and its map."""
    folder.mkdir()
    for name in ("calibration.json", "ground_truth.json"):
        shutil.copy(STREET / name, folder)
    lines = (STREET / "frames.csv").read_text().splitlines()[: frames + 1]
    (folder / "frames.csv").write_text("\n".join(lines))
    for line in lines[1:]:
        for name in (cell for cell in line.split(",") if cell.endswith(".jpg")):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(STREET / name, folder / name)
    return folder
