"""How exact `odometry` is.

    python tests/tools/odometry_accuracy.py DRIVE… [--every N] [--cameras NAMES] [--scores MODEL]

The drives' own poses count as right. The measurement does not get them. `odometry_drives.py` renders drives for it.
"""

import argparse
import json
import resource
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from bevcli.frame import DerivedDrive, Drive, Frame
from bevcli.geometry.transforms import Array, Pose, inverse
from bevcli.inference import StepOptions
from bevcli.inference.load import load_model
from bevcli.printing import say
from bevcli.sequences.open import DriveView, open_sequence
from bevcli.sequences.options import InputOptions
from bevcli.workshop.odometry.measure import MeasuredMotion, measure_motion
from bevcli.workshop.training.validation import score_drives

SHORTEST_WAY_M = 5.0  # of a drive whose end is stated in per cent
SHORTEST_STEP_M = 0.5  # of a step whose length is stated in per cent
COMPONENTS = "roll", "pitch", "yaw", "x", "y", "z"


@dataclass(frozen=True)
class StepError:
    """The error of one step.

    Attributes:
        index: of its first frame.
        moved_m: right length.
        turned_deg: right angle of the rotation.
        error_m: distance of the measured from the right position.
        error_deg: angle between the measured and the right rotation.
        length_error: of the measured length, relative to the right one.
        reason: why it was not measured; "" if it was.
        errors: (6,) of rotation about x, y, z (radians) and position (metres), ego frame of the first frame.
        deviations: (6,) that the measurement states for them.
        matches: number of matched points.
        road_points: number of points of the road.
    """

    index: int
    moved_m: float
    turned_deg: float
    error_m: float
    error_deg: float
    length_error: float
    reason: str
    errors: tuple[float, ...]
    deviations: tuple[float, ...]
    matches: int
    road_points: int


@dataclass(frozen=True)
class DriveErrors:
    """The errors of one drive.

    Attributes:
        drive: its name.
        steps: one a pair of successive frames.
        way_m: right length of the way.
        end_m: distance of the measured from the right end.
        processor_s: processor time of a step, with reading and decoding the images.
    """

    drive: str
    steps: tuple[StepError, ...]
    way_m: float
    end_m: float
    processor_s: float


class WithoutPoses(DerivedDrive):
    """A drive of one rig whose poses are all the identity, as of one without ego-motion, with some of its cameras."""

    def __init__(self, sequence: Drive, cameras: list[str] | None = None) -> None:
        super().__init__(sequence)
        self._names = list(sequence.rig.names) if cameras is None else cameras
        self.rig = replace(sequence.rig, cameras=tuple(sequence.rig[name] for name in self._names))
        self.has_ego_motion, self.ego_motion = False, None

    def load(self, index: int) -> Frame:
        frame, nowhere = self.drive.load(index), Pose.from_matrix(np.eye(4))
        still = replace(frame.kinematics, angular_rate=np.zeros(3), velocity=np.zeros(3))
        return replace(
            frame,
            rig=self.rig,
            images={name: frame.images[name] for name in self._names if name in frame.images},
            world_from_ego=nowhere,
            world_from_ego_at=dict.fromkeys(self._names, nowhere),
            kinematics=still,
        )


def measured(drive: Drive, cameras: list[str] | None = None) -> tuple[DriveErrors, MeasuredMotion]:
    """The errors of a drive with poses, and what was measured."""
    begin = time.process_time()
    motion = measure_motion(WithoutPoses(drive, cameras))
    processor_s = (time.process_time() - begin) / max(len(motion.steps), 1)
    right = true_poses(drive)
    ends = inverse(right[0]) @ right[-1]
    steps = tuple(step_errors(motion, right))
    way_m = sum(step.moved_m for step in steps)
    off_m = float(np.linalg.norm(motion.poses[-1][:3, 3] - ends[:3, 3]))
    return DriveErrors(drive.name, steps, way_m, off_m, processor_s), motion


def true_poses(drive: Drive) -> Array:
    """(F, 4, 4) world_from_ego of the frames as the drive states them."""
    motion = drive.ego_motion
    assert motion is not None
    return np.stack([motion.pose_at(stamp.timestamp_ns).matrix for stamp in drive.stamps])


def step_errors(motion: MeasuredMotion, right: Array) -> Iterator[StepError]:
    """The error of each step. right: (F, 4, 4) true poses."""
    for index, step in enumerate(motion.steps):
        true, found = inverse(right[index]) @ right[index + 1], step.ego_a_from_ego_b
        turn = Rotation.from_matrix(found[:3, :3] @ true[:3, :3].T).as_rotvec()
        shift, moved_m = found[:3, 3] - true[:3, 3], float(np.linalg.norm(true[:3, 3]))
        yield StepError(
            index,
            moved_m,
            float(np.degrees(Rotation.from_matrix(true[:3, :3]).magnitude())),
            float(np.linalg.norm(shift)),
            float(np.degrees(np.linalg.norm(turn))),
            float(np.linalg.norm(found[:3, 3])) / moved_m - 1 if moved_m > 1e-6 else 0.0,
            step.reason,
            tuple(np.concatenate([turn, shift]).tolist()),
            tuple(np.sqrt(np.diag(step.covariance)).tolist()),
            step.matches,
            step.road_points,
        )


HEAD = (
    "drive               steps  not  step error: median, 95 %, most           end of the way       length,  in 3 sd"
    "  |e|/sd  s a step"
)


def row(name: str, drives: list[DriveErrors]) -> str:
    """One row of the table: the errors of some drives together."""
    steps = [step for drive in drives for step in drive.steps]
    seen = [step for step in steps if not step.reason] or steps
    metres, degrees = (np.array([getattr(step, part) for step in seen]) for part in ("error_m", "error_deg"))
    lengths = [abs(step.length_error) for step in seen if step.moved_m > SHORTEST_STEP_M]
    ratios = np.abs([np.divide(step.errors, step.deviations) for step in steps])
    ends = [drive.end_m / drive.way_m for drive in drives if drive.way_m > SHORTEST_WAY_M]
    off_m = np.mean([drive.end_m for drive in drives])
    end = f"{100 * off_m:6.1f} cm" + (f", {np.median(ends):.2%}, {max(ends):.2%}" if ends else ", -, -")
    quantiles = [np.quantile(values, (0.5, 0.95, 1)) for values in (metres, degrees)]
    return (
        f"{name[-19:]:<19} {len(steps):>5} {sum(bool(step.reason) for step in steps):>4}  "
        f"{' '.join(f'{100 * value:5.1f}' for value in quantiles[0])} cm "
        f"{' '.join(f'{value:6.3f}' for value in quantiles[1])}°  {end:<24} "
        f"{max(lengths, default=0):>7.1%}  {(ratios <= 3).mean():>6.1%}  {np.median(ratios):>6.2f}  "
        f"{np.mean([drive.processor_s for drive in drives]):>8.2f}"
    )


class OpenDrives:
    """Drives that are open, to score a model on."""

    input_shapes = None

    def __init__(self, drives: list[Drive]) -> None:
        self._drives = drives

    def __len__(self) -> int:
        return len(self._drives)

    def open(self, index: int) -> Drive:
        return self._drives[index]


def scores(paths: list[Path], motions: list[MeasuredMotion], model: str) -> Iterator[str]:
    """A line each for a model's scores with the right and with the measured motion, and their ratio."""
    loaded = load_model(model)
    options, runner = InputOptions(every=1, classes=loaded.config.classes), loaded.runner(StepOptions(track=False))
    right = [open_sequence(path, options) for path in paths]
    measured_drives = [
        DriveView(drive, motions=dict.fromkeys((stamp.scene for stamp in drive.stamps), motion.ego_motion))
        for drive, motion in zip(right, motions, strict=True)
    ]
    found = []
    for name, drives in (("right", right), ("measured", measured_drives)):
        opened = OpenDrives(list(drives))
        found.append(score_drives(runner, opened, each_drive=True))
        yield f"{name} motion: {found[-1]}"
        yield "  " + ", ".join(f"{each.name} {each.nd_score:.3f}" for each in found[-1].drives)
    ratio = found[1].summary()["NDS"] / found[0].summary()["NDS"]
    yield f"NDS with measured motion: {ratio:.1%} of that with the right one"


def worst(drive: DriveErrors, count: int) -> Iterator[str]:
    """A line for each of the worst steps of a drive, largest error first."""
    for step in sorted(drive.steps, key=lambda step: -max(step.error_m / 0.05, step.error_deg / 0.1))[:count]:
        parts = zip(COMPONENTS, step.errors, step.deviations, strict=True)
        ratios = " ".join(f"{name} {error / deviation:+.1f}" for name, error, deviation in parts)
        yield (
            f"  {drive.drive} {step.index}: moved {step.moved_m:.2f} m, turned {step.turned_deg:.1f}°; off "
            f"{100 * step.error_m:.1f} cm ({step.length_error:+.1%}), {step.error_deg:.3f}°; in sd: {ratios}; "
            f"{step.matches} matches, {step.road_points} of the road; {step.reason}"
        )


def main() -> None:
    """Print the table of the drives on the command line; `--json FILE` also writes every error."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("drives", nargs="+", type=Path)
    parser.add_argument("--every", type=int, default=1, help="only every N-th frame")
    parser.add_argument("--cameras", help="only these, separated by commas")
    parser.add_argument("--scores", metavar="MODEL", help="also score a model with the right and the measured motion")
    parser.add_argument("--worst", type=int, default=0, help="also show as many steps of each drive")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    drives: list[DriveErrors] = []
    motions: list[MeasuredMotion] = []
    say(HEAD)
    for path in given.drives:
        drive = open_sequence(path, ground_truth=False, every=given.every)
        errors, motion = measured(drive, given.cameras and given.cameras.split(","))
        drives.append(errors)
        motions.append(motion)
        say(row(path.name, [errors]))
        for line in worst(errors, given.worst):
            say(line)
        if given.json is not None:
            entries: list[dict[str, Any]] = [asdict(each) for each in drives]
            given.json.write_text(json.dumps(entries, indent=1))
    rigs = sorted({each.drive.split("-")[0] for each in drives})
    for rig in rigs if len(rigs) > 1 else ():
        say(row(f"all {rig}", [each for each in drives if each.drive.split("-")[0] == rig]))
    say(row("all", drives))
    say(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MiB")
    if given.scores:
        for line in scores(given.drives, motions, given.scores):
            say(line)


if __name__ == "__main__":
    main()
