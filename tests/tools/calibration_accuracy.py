"""How well `calibrate` finds planted noise: `python tests/tools/calibration_accuracy.py DRIVE… --levels 1,2,3,4`.

The drives' own calibration counts as right. Points are matched once a drive, because they do not depend on the noise.
"""

import argparse
import json
from collections.abc import Generator, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np

from bevcli.frame import DerivedDrive, Drive, Frame
from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array
from bevcli.printing import say
from bevcli.sequences.open import open_sequence
from bevcli.workshop.calibration import CalibrateOptions
from bevcli.workshop.calibration.calibrate import CalibrationResult, judge, measure
from bevcli.workshop.calibration.estimates import CameraEstimate, Verdict, delay_text
from bevcli.workshop.calibration.views import Views, match_points, read_views
from bevcli.workshop.robustness.conditions import CalibrationNoise, Draws

Result = TypeVar("Result")
LARGEST_MEASURED_M = 0.05  # deviation of a height that counts as measured


@dataclass(frozen=True)
class CameraError:
    """What is left of the planted noise of one camera.

    Attributes:
        drive: its name.
        level: of the noise.
        seed: of the noise.
        camera: its name.
        verdict: of `calibrate`.
        rotation_deg: angle between the corrected and the right rotation.
        height_m: corrected minus right height.
        height_is_measured: whether its deviation is small enough.
        errors: (6,) of the measurement: rotation about right, down, forward axis (radians) and position (metres).
        deviations: (6,) that the measurement states for them.
    """

    drive: str
    level: int
    seed: int
    camera: str
    verdict: str
    rotation_deg: float
    height_m: float
    height_is_measured: bool
    errors: tuple[float, ...]
    deviations: tuple[float, ...]


def done(work: Generator[None, None, Result]) -> Result:
    """The result of work that is done in parts."""
    while True:
        try:
            next(work)
        except StopIteration as end:
            return end.value


def errors_of_drive(drive: Drive, levels: list[int], seeds: list[int]) -> Iterator[CameraError]:
    """Measure the calibration of a drive once a level and seed, and yield what is left for each camera."""
    options = CalibrateOptions()
    views = done(read_views(drive, options.pairs))
    matches = match_points(views)
    for level in levels:
        for seed in seeds:
            noisy = _with_noise(drive, views, level, seed)
            result = judge(drive, done(measure(noisy, matches, options)))
            for right, estimate in zip(views.stated.cameras, result.cameras, strict=True):
                yield _error(drive.name, level, seed, right, result, estimate)


class WrongTimes(DerivedDrive):
    """A drive with ego-motion in which one camera states times, and poses at them, that are too late by a constant."""

    def __init__(self, sequence: Drive, camera: str, late_ms: float) -> None:
        super().__init__(sequence)
        self._camera, self._late_ns = camera, round(late_ms * 1e6)

    def load(self, index: int) -> Frame:
        frame, name, motion = self.drive.load(index), self._camera, self.ego_motion
        if name not in frame.images or motion is None:
            return frame
        time = frame.images[name].timestamp_ns + self._late_ns
        pose = motion.pose_at(min(max(time, motion.first_ns), motion.last_ns))
        images = {**frame.images, name: replace(frame.images[name], timestamp_ns=time)}
        return replace(frame, images=images, world_from_ego_at={**frame.world_from_ego_at, name: pose})


def delays_of_drive(drive: Drive, delays_ms: list[float]) -> Iterator[str]:
    """One line for each camera and delay: the delay that is found, and its deviation."""
    options = CalibrateOptions()
    views = done(read_views(drive, options.pairs))
    matches = match_points(views)
    for index, late_ms in enumerate(delays_ms):
        camera = views.rig.names[index % len(views.rig.names)]
        late = done(read_views(WrongTimes(drive, camera, late_ms), options.pairs))
        found = judge(drive, done(measure(late, matches, options)))[camera]
        turned = np.degrees(np.linalg.norm(found.change[:3]))
        yield (
            f"{drive.name} {camera}: planted {-late_ms:+.0f} ms, found {found.delay_ms:+.1f} ± "
            f"{found.delay_deviation_ms:.1f} ms, rotation changed by {turned:.2f}°; {delay_text(found) or 'not told'}"
        )


def _with_noise(drive: Drive, views: Views, level: int, seed: int) -> Views:
    """The views with the noisy rig that `bevcli stress` would state."""
    if not level:
        return views
    stated = CalibrationNoise(drive, level, Draws(seed, "calibration_noise")).load(0).rig
    pairs = zip(views.rig.cameras, stated.cameras, strict=True)
    cameras = tuple(replace(camera, ego_from_camera=noisy.ego_from_camera) for camera, noisy in pairs)
    return replace(views, stated=stated, rig=replace(views.rig, cameras=cameras))


def _error(
    drive: str, level: int, seed: int, right: Camera, result: CalibrationResult, estimate: CameraEstimate
) -> CameraError:
    corrected = result.rig[right.name].ego_from_camera
    deviations = np.sqrt(np.diag(estimate.covariance))[:6]
    measured = result.stated[right.name].ego_from_camera.copy()
    measured[:3, :3] = measured[:3, :3] @ cv2.Rodrigues(estimate.change[:3])[0]
    measured[:3, 3] += estimate.change[3:6]
    return CameraError(
        drive,
        level,
        seed,
        right.name,
        estimate.verdict.value,
        float(np.degrees(np.linalg.norm(_difference(right, corrected)[:3]))),
        float(corrected[2, 3] - right.ego_from_camera[2, 3]),
        bool(deviations[5] < LARGEST_MEASURED_M),
        tuple(_difference(right, measured).tolist()),
        tuple(deviations.tolist()),
    )


def _difference(right: Camera, pose: Array) -> Array:
    """(6,) rotation in the camera frame, radians, and position in the ego frame, metres."""
    turn = cv2.Rodrigues(right.ego_from_camera[:3, :3].T @ pose[:3, :3])[0].ravel()
    return np.concatenate([turn, pose[:3, 3] - right.ego_from_camera[:3, 3]])


def table(errors: list[CameraError]) -> str:
    """One row a level: what is left, and how the errors compare with their stated deviations."""
    rows = ["level  cameras  measured  rotation left (median, 95 %)  height left (median, 95 %)  |e|/sd  within 3 sd"]
    for level in [*sorted({each.level for each in errors}), None]:
        mine = [each for each in errors if level is None or each.level == level]
        seen = [each for each in mine if each.verdict != Verdict.NOT_MEASURABLE.value]
        turned = [each.rotation_deg for each in seen]
        heights = [abs(each.height_m) for each in seen if each.height_is_measured]
        ratios = np.abs([np.divide(each.errors, each.deviations) for each in seen])
        rows.append(
            f"{'all' if level is None else level!s:>5}  {len(mine):>7}  {len(seen):>8}  "
            f"{np.median(turned):>12.3f}° {np.quantile(turned, 0.95):>14.3f}°  "
            f"{100 * np.median(heights):>9.1f} cm {100 * np.quantile(heights, 0.95):>10.1f} cm ({len(heights)})  "
            f"{np.median(ratios):>6.2f}  {(ratios <= 3).mean():>11.1%}"
        )
    return "\n".join(rows)


def main() -> None:
    """Print the table of the drives on the command line; `--json FILE` also writes every error."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("drives", nargs="+", type=Path)
    parser.add_argument("--levels", default="1,2,3,4")
    parser.add_argument("--seeds", default="0")
    parser.add_argument("--delays-ms", default="", help="instead: wrong capture times of one camera after the other")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    levels, seeds = ([int(number) for number in text.split(",")] for text in (given.levels, given.seeds))
    if given.delays_ms:
        for path in given.drives:
            drive = open_sequence(path, ground_truth=False)
            for line in delays_of_drive(drive, [float(number) for number in given.delays_ms.split(",")]):
                say(line)
        return
    errors: list[CameraError] = []
    for path in given.drives:
        errors += errors_of_drive(open_sequence(path, ground_truth=False), levels, seeds)
        say(f"{path.name}: {len(errors)} cameras so far", err=True)
        if given.json is not None:
            entries: list[dict[str, Any]] = [asdict(each) for each in errors]
            given.json.write_text(json.dumps(entries, indent=1))
    say(table(errors))


if __name__ == "__main__":
    main()
