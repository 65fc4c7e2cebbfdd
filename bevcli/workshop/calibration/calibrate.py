"""`calibrate`: a drive -> how far its calibration is off, from what its images show between two frames.

`motion_findings`: the same in short, as findings for `bevcli project-debug`.
"""

import json
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bevcli.errors import InputError
from bevcli.findings import Finding
from bevcli.frame import DerivedSequence, DriveFacts, Frame, Sequence
from bevcli.geometry.cameras import Camera, CameraRig
from bevcli.geometry.transforms import Array
from bevcli.options import gather
from bevcli.sequences.files.calibration_file import write_calibration
from bevcli.workshop.calibration.adjustment import HEIGHT, OF_CAMERA, OF_RIG, Solution, Unknowns, moved, values
from bevcli.workshop.calibration.estimates import (
    CameraEstimate,
    RigEstimate,
    Verdict,
    change_text,
    delay_text,
    either_text,
    rig_text,
    table,
)
from bevcli.workshop.calibration.measure import PARTS, Measurement, match_points, measure
from bevcli.workshop.calibration.options import CalibrateOptions
from bevcli.workshop.calibration.views import FEWEST_PAIRS, READING_STEPS, WIDTH, read_views
from bevcli.writing import write_whole

FEWEST_MATCHES = 100  # of a camera
WIDEST_DEG = 0.3  # deviation of a rotation that counts as measured
FINE = np.array([np.radians(0.2)] * 3 + [0.03, 0.03, 0.015])  # changes that are not worth a correction,
FINE_DEVIATIONS = 4.0  # or less than this many standard deviations: where few pairs agree by chance, 3.6 were seen
LEAST_INFORMATION = 3.0  # of a direction, in that of the stated value: the deviation is then halved at least
LEAST_FACTOR = 0.5  # of variances, by which the agreement of the pairs may make them smaller
FINEST = np.array([np.radians(0.01)] * 3 + [0.001] * 3 + [0.001])  # errors of lens and images: radians, metres, seconds
STEPS = READING_STEPS + 1 + PARTS  # of the work, for progress
SHORT_PAIRS = 8  # of frames, for findings


@dataclass(frozen=True)
class CalibrationResult:
    """The result of `calibrate`.

    Attributes:
        name: of the drive.
        stated: the rig of the drive.
        rig: the corrected rig; cameras that are fine or not measurable are as stated.
        cameras: the estimates, in the rig's order.
        whole: what is said about the whole rig.
        pairs: number of frame pairs that were used.
        facts: of the drive, for calibration.json.
    """

    name: str
    stated: CameraRig
    rig: CameraRig
    cameras: tuple[CameraEstimate, ...]
    whole: RigEstimate
    pairs: int
    facts: DriveFacts

    def __getitem__(self, camera: str) -> CameraEstimate:
        return next(each for each in self.cameras if each.camera == camera)

    def text(self) -> str:
        """One row a camera, and lines about the whole rig, for a terminal."""
        pairs = f"{self.name}: {self.pairs} frame pairs; off by: stated minus measured, ± standard deviation"
        return "\n".join([table(self.cameras), "", pairs, rig_text(self.whole, self.cameras)])

    def to_json(self) -> str:
        """The content of report.json."""
        content = {
            "drive": self.name,
            "pairs": self.pairs,
            "cameras": {each.camera: each.to_dict() for each in self.cameras},
            "rig": asdict(self.whole),
        }
        return json.dumps(content, indent=1, ensure_ascii=False)

    def write(self, folder: Path | str) -> list[Path]:
        """Write calibration.json (the corrected rig) and report.json into a folder. Returns their paths.

        The folder is made where it is missing; existing files are overwritten. Raises OutputError.
        """
        rig, report = Path(folder) / "calibration.json", Path(folder) / "report.json"
        write_whole(report, f"{self.to_json()}\n".encode(), parents=True)
        write_calibration(rig, self.rig, self.facts)
        return [rig, report]


class CorrectedDrive(DerivedSequence):
    """The calibrated drive, with the corrected rig in every frame."""

    def __init__(self, sequence: Sequence, result: CalibrationResult) -> None:
        super().__init__(sequence)
        self.rig = result.rig

    def load(self, index: int) -> Frame:
        return replace(self.sequence.load(index), rig=self.rig)


def calibrate(
    drive: Sequence,
    options: CalibrateOptions | None = None,
    *,
    after_step: Callable[[], None] = lambda: None,
    **changes: Any,
) -> CalibrationResult:
    """Measure the calibration of a drive from its own images and ego-motion.

        result = calibrate(open_sequence("my_drive"))
        print(result.text())
        result.write("rig")

    What the images show between two frames must fit how the vehicle moved. Matched points tell the rotation of each
    camera, and its position where the drive turns; the flat road tells its height, pitch and roll. All are estimated
    together, about the stated values. What the drive does not show stays as it is stated.

    Args:
        drive: of `open_sequence`, one scene with ego-motion.
        options: see `CalibrateOptions`.
        after_step: called STEPS times, after each part of the work.
        changes: options as keywords.

    Raises InputError where the drive does not show how its cameras move: no ego-motion, too few frames, a vehicle that
    stands, black images, or several scenes.
    """
    chosen = gather(CalibrateOptions, options, changes)
    views = read_views(drive, chosen.pairs, after_step)
    matches = match_points(views)
    after_step()
    if not matches.same.any():
        raise InputError(
            f"{drive.name}: no points were found in both frames of a pair (expected {FEWEST_MATCHES} or more a "
            "camera): choose a part of the drive in which the images are sharp and show something"
        )
    return judge(drive, measure(views, matches, chosen, after_step))


def judge(drive: Sequence, measurement: Measurement) -> CalibrationResult:
    """The result of a measurement: what is observed, with a verdict for each camera."""
    changes, covariances, whole = observed(measurement)
    stated, unknowns, pairs = measurement.views.stated, measurement.unknowns, len(measurement.views.pairs)
    cameras = tuple(_estimate(index, measurement, changes[index], covariances[index]) for index in range(len(changes)))
    rig = replace(
        stated,
        cameras=tuple(
            replace(camera, ego_from_camera=pose) if estimate.verdict is Verdict.CORRECTED else camera
            for camera, pose, estimate in zip(stated.cameras, moved(unknowns.stated, changes), cameras, strict=True)
        ),
    )
    return CalibrationResult(drive.name, stated, rig, cameras, whole, pairs, drive.facts)


def _estimate(index: int, measurement: Measurement, change: Array, covariance: Array) -> CameraEstimate:
    """change, covariance: of `observed`, (7,) and (7, 7)."""
    views, groups = measurement.views, measurement.matches.group
    deviations = np.sqrt(np.diag(covariance))
    mine = (measurement.unknowns.groups[groups, 1:] == index).all(-1)
    count, pairs = int(mine.sum()), len(np.unique(groups[mine]))
    reason = _reason(count, pairs, np.degrees(deviations[:3]), views.stated.cameras[index])
    enlarged = views.stated.cameras[index].width / views.rig.cameras[index].width
    solution = measurement.solution.x
    before, after = (_residual_px(measurement, index, x) * enlarged for x in (0 * solution, solution))
    road = measurement.unknowns.groups[measurement.road.group, 1] == index
    fine = np.abs(change[:6]) <= np.maximum(FINE, FINE_DEVIATIONS * deviations[:6])
    verdict = Verdict.FINE if fine.all() else Verdict.CORRECTED
    return CameraEstimate(
        camera=views.rig.names[index],
        verdict=Verdict.NOT_MEASURABLE if reason else verdict,
        reason=reason,
        rotation_deg=_yaw_pitch_roll(-np.degrees(change[:3])),
        rotation_deviation_deg=_yaw_pitch_roll(np.degrees(deviations[:3]) * [1, -1, 1]),
        position_m=tuple((-change[3:6]).tolist()),
        position_deviation_m=tuple(deviations[3:6].tolist()),
        delay_ms=1000 * float(change[6]),
        delay_deviation_ms=1000 * float(deviations[6]),
        matches=count,
        road_points=int(road.sum()),
        before_px=before,
        after_px=after,
        change=change,
        covariance=covariance,
    )


def _reason(matches: int, pairs: int, deviations_deg: Array, camera: Camera) -> str:
    """Why a camera is not measurable; "" where it is. Of small images, with the size that would do."""
    # Matches grow with the area of an image, deviations shrink with its width.
    wanted = camera.width * max(np.sqrt(FEWEST_MATCHES / max(matches, 1)), deviations_deg.max() / WIDEST_DEG)
    width = int(min(WIDTH, 10 * np.ceil(wanted / 10)))
    height = round(camera.height * width / camera.width)
    stated = f"{camera.width} x {camera.height}"
    size = f"; its images are {stated}: about {width} x {height} would do" if width > camera.width else ""
    if matches < FEWEST_MATCHES:
        return f"{matches} matches{size}"
    if pairs < FEWEST_PAIRS:
        return f"matches in {pairs} frame pairs"
    if deviations_deg.max() > WIDEST_DEG:
        return f"the drive shows its rotation to ±{deviations_deg.max():.1f}° only{size}"
    return ""


def _residual_px(measurement: Measurement, index: int, x: Array) -> float:
    mine = (measurement.unknowns.groups[measurement.points.group, 1:] == index).all(-1)
    residuals_px = np.abs(values(measurement.unknowns, measurement.points, x)[mine])
    return float(np.median(residuals_px)) if residuals_px.size else 0.0


def _yaw_pitch_roll(turn: Array) -> tuple[float, float, float]:
    """Small turns (3,) about right, down and forward axes of a camera as yaw (to the left), pitch (up) and roll."""
    return -float(turn[1]), float(turn[0]), float(turn[2])


def observed(measurement: Measurement) -> tuple[Array, Array, RigEstimate]:
    """The changes along directions that the drive shows, with their covariance; all else stays as it is stated.

    Returns:
        (C, 7) rotation, radians in the camera frame; position, metres in the ego frame; delay, seconds.
        (C, 7, 7) covariances of them; a direction that is not observed has the deviation of the stated value.
        The whole rig.
    """
    unknowns, solution = measurement.unknowns, measurement.solution
    deviations, count = unknowns.deviations, OF_CAMERA * unknowns.cameras
    covariance = _honest(unknowns, solution)
    scale = deviations[:count]
    marginal = np.linalg.inv(covariance[:count, :count] / np.outer(scale, scale)) - np.eye(count)
    sizes, axes = np.linalg.eigh((marginal + marginal.T) / 2)
    seen, unseen = axes[:, sizes >= LEAST_INFORMATION], axes[:, sizes < LEAST_INFORMATION]
    change = scale * (seen @ (seen.T @ (solution.x[:count] / scale)))
    within = seen @ np.diag(1 / (1 + sizes[sizes >= LEAST_INFORMATION])) @ seen.T + unseen @ unseen.T
    whole = np.outer(scale, scale) * within + np.diag(np.tile(FINEST, unknowns.cameras) ** 2)
    blocks = whole.reshape(unknowns.cameras, OF_CAMERA, unknowns.cameras, OF_CAMERA)
    changes = unknowns.of_camera(change)
    of_rig, of_rig_deviations = solution.x[-OF_RIG:], np.sqrt(np.diag(covariance)[-OF_RIG:])
    (along, across), (along_deviation, across_deviation) = np.degrees([of_rig[1:], of_rig_deviations[1:]]).tolist()
    rig = RigEstimate(
        scale=float(of_rig[0]),
        scale_deviation=float(of_rig_deviations[0]),
        height_m=-float(changes[:, HEIGHT].mean()),
        height_deviation_m=float(np.sqrt(blocks[:, HEIGHT, :, HEIGHT].sum()) / unknowns.cameras),
        tilt_deg=(along, across),
        tilt_deviation_deg=(along_deviation, across_deviation),
    )
    return changes, np.stack([blocks[c, :, c] for c in range(unknowns.cameras)]), rig


def _honest(unknowns: Unknowns, solution: Solution) -> Array:
    """The covariance (P, P), each unknown scaled by how well the frame pairs agree about it: the jackknife.

    The result without a pair differs by what that pair pulls. So an unknown that a single pair tells is not believed,
    however small its residuals are.
    """
    prior = np.diag(1 / unknowns.deviations**2)
    matrix = solution.information + prior
    covariance: Array = np.asarray(np.linalg.inv(matrix), dtype=np.float64)
    pulls = []
    for pair in range(unknowns.pairs):
        groups = unknowns.groups[:, 0] == pair
        pulls.append(np.linalg.solve(matrix - solution.information_of(groups), solution.gradient_of(groups)))
    agreed = (np.square(pulls).sum(0) + np.diag(covariance @ prior @ covariance)) / np.diag(covariance)
    factor = np.sqrt(np.maximum(agreed, LEAST_FACTOR))
    return covariance * np.outer(factor, factor)


def motion_findings(drive: Sequence) -> tuple[Finding, ...]:
    """Findings about the cameras whose calibration does not fit how the vehicle moves, measured from a few frames."""
    try:
        result = calibrate(drive, pairs=SHORT_PAIRS)
    except InputError as error:
        return (Finding("motion-not-measured", "info", None, f"the drive does not show its calibration: {error}"),)
    return findings_of(result.cameras)


def findings_of(cameras: Iterable[CameraEstimate]) -> tuple[Finding, ...]:
    """A finding for each camera that is corrected, and for each whose capture times are off."""
    findings = []
    for estimate in cameras:
        name = estimate.camera
        if estimate.verdict is Verdict.CORRECTED:
            message, advice = "does not fit how the vehicle moves", "measure it with `bevcli calibrate`"
            findings.append(Finding("calibration-off", "warning", name, message, change_text(estimate), "", advice))
        if delay_text(estimate):
            late = f"{estimate.delay_ms:+.0f} ms ± {estimate.delay_deviation_ms:.0f} ms"
            message, advice = "its images were taken at another time than stated", "correct its timestamps"
            findings.append(Finding("capture-times-off", "warning", name, message, late, "0 ms", advice))
        if either_text(estimate):
            advice = "choose a part of the drive that turns and drives straight on"
            findings.append(Finding("capture-times-off", "warning", name, either_text(estimate), "", "", advice))
    return tuple(findings)
