"""The report of a measured motion: length, speed, deviations, steps that are guesses; against stated poses.

Functions of a `MeasuredMotion`, and the files that `bevcli odometry` writes of it.
"""

import json
from collections import Counter
from collections.abc import Iterator, Sequence as Items
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from bevcli.errors import Finding, InputError
from bevcli.frame import Drive
from bevcli.geometry.ego_motion import EgoMotion
from bevcli.geometry.transforms import Array, inverse
from bevcli.printing import aligned, counted
from bevcli.sequences.open import DriveView, select, select_rate
from bevcli.workshop.formats.output import write_ego_motion
from bevcli.workshop.odometry.measure import MeasuredMotion, MeasuredStep, measure_steps
from bevcli.writing import write_whole

KMH = 3.6
CM, PERCENT = 100, 100
COMMON = 0.5  # share of the variance of a step that the others have too


def seconds_of(motion: MeasuredMotion) -> Array:
    """(F - 1,) duration of each step."""
    return np.diff(motion.timestamps_ns) / 1e9


def lengths_m(motion: MeasuredMotion) -> Array:
    """(F - 1,) length of each step."""
    return np.array([float(np.linalg.norm(step.ego_a_from_ego_b[:3, 3])) for step in motion.steps])


def speeds(motion: MeasuredMotion) -> tuple[Array, Array]:
    """(F - 1,) speed along the ego x axis, m/s, and standard deviations: negative where the vehicle drives back."""
    seconds = seconds_of(motion)
    ahead = np.array([step.ego_a_from_ego_b[0, 3] for step in motion.steps])
    signed = np.where(ahead < 0, -1, 1) * lengths_m(motion)
    deviations = [np.sqrt(_along(step) @ step.covariance[3:, 3:] @ _along(step)) for step in motion.steps]
    return signed / seconds, np.array(deviations) / seconds


def _along(step: MeasuredStep) -> Array:
    """(3,) the direction of a step; x where the vehicle stands."""
    length = np.linalg.norm(step.ego_a_from_ego_b[:3, 3])
    return step.ego_a_from_ego_b[:3, 3] / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])


def yaw_rates_deg(motion: MeasuredMotion) -> tuple[Array, Array]:
    """(F - 1,) yaw rate, degrees per second, to the left, and standard deviations."""
    seconds = seconds_of(motion)
    yaws = np.array([_turn_deg(step.ego_a_from_ego_b)[2] for step in motion.steps])
    deviations = np.degrees([np.sqrt(step.covariance[2, 2]) for step in motion.steps])
    return yaws / seconds, deviations / seconds


def _turn_deg(motion: Array) -> Array:
    """(3,) rotation vector of a motion (4, 4), degrees."""
    return np.asarray(np.degrees(Rotation.from_matrix(motion[:3, :3]).as_rotvec()))


def end_deviations(motion: MeasuredMotion) -> tuple[float, float]:
    """Standard deviations of the last pose: distance, metres, and rotation, degrees.

    An error of a step's rotation turns all that follows. COMMON of each variance counts as an error of the calibration,
    such as of a height, which is the same in all steps; the rest is independent.
    """
    poses, end = motion.poses, motion.poses[-1][:3, 3]
    independent, common = np.zeros(6), np.zeros((6, 6))  # of the place and the rotation vector, world frame
    for pose, following, step in zip(poses, poses[1:], motion.steps, strict=False):
        x, y, z = end - following[:3, 3]
        cross, turn = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]), pose[:3, :3]
        gain = np.block([[-cross @ turn, turn], [turn, np.zeros((3, 3))]])
        independent += np.diag(gain @ step.covariance @ gain.T)
        common += gain @ np.linalg.cholesky(step.covariance + 1e-18 * np.eye(6))
    variances = (1 - COMMON) * independent + COMMON * (common**2).sum(-1)
    return float(np.sqrt(variances[:3].sum())), float(np.degrees(np.sqrt(variances[3:].sum())))


@dataclass(frozen=True)
class StatedDifference:
    """The measured motion against the poses that the drive states."""

    end_m: float  # distance between both ends of the way, where both begin at the same pose
    end_deg: float  # angle between both last poses
    length_m: float  # length of the stated way
    steps_m: Array  # (F - 1,) difference of each step, metres
    steps_deg: Array  # (F - 1,) the same of its rotation, degrees

    def text(self) -> str:
        """One line."""
        share = f" ({PERCENT * self.end_m / self.length_m:.1f} %)" if self.length_m > 1 else ""
        step_m, step_deg = np.median(self.steps_m), np.median(self.steps_deg)
        return (
            f"end of the way {self.end_m:.2f} m{share} and {self.end_deg:.2f}° apart; "
            f"a step {CM * step_m:.1f} cm and {step_deg:.3f}° (medians)"
        )

    def to_dict(self) -> dict[str, Any]:
        """For the report."""
        return {name: np.asarray(value).tolist() for name, value in vars(self).items()}


def against_stated(motion: MeasuredMotion, stated_poses: Items[Array]) -> StatedDifference | None:
    """The difference to stated poses (F, 4, 4), world_from_ego; None without steps."""
    if not motion.steps:
        return None
    steps = [inverse(a) @ b for a, b in pairwise(stated_poses)]
    apart = [inverse(step.ego_a_from_ego_b) @ other for step, other in zip(motion.steps, steps, strict=True)]
    end = inverse(motion.poses[-1]) @ inverse(stated_poses[0]) @ stated_poses[-1]
    return StatedDifference(
        end_m=float(np.linalg.norm(end[:3, 3])),
        end_deg=float(np.linalg.norm(_turn_deg(end))),
        length_m=float(sum(np.linalg.norm(step[:3, 3]) for step in steps)),
        steps_m=np.array([np.linalg.norm(difference[:3, 3]) for difference in apart]),
        steps_deg=np.array([np.linalg.norm(_turn_deg(difference)) for difference in apart]),
    )


def not_measured(motion: MeasuredMotion) -> Counter[str]:
    """The number of steps that are guesses, by their reason."""
    return Counter(step.reason for step in motion.steps if step.reason)


def check_measured(motion: MeasuredMotion) -> None:
    """Raise InputError where there are steps, and not one of them was measured."""
    reasons = not_measured(motion)
    if motion.steps and sum(reasons.values()) == len(motion.steps):
        raise InputError(
            f"{motion.name}: not one of {len(motion.steps)} steps could be measured ({next(iter(reasons))}): "
            "expected images of a road in daylight or lamplight, and a calibration that fits them"
        )


def measured_note(motion: MeasuredMotion) -> str:
    """One line about a drive that is used with its measured motion."""
    guessed = _reasons(motion)
    text = f"the ego-motion is measured from the images: {lengths_m(motion).sum():.1f} m in {_steps(motion)}"
    return f"{text}; not measured: {guessed}" if guessed else text


def _steps(motion: MeasuredMotion) -> str:
    return counted(len(motion.steps), "steps")


def _reasons(motion: MeasuredMotion) -> str:
    """The steps that are guesses, in words; "" without any."""
    reasons = not_measured(motion)
    return "; ".join(f"{counted(count, 'steps')} ({reason})" for reason, count in reasons.most_common())


def report_text(motion: MeasuredMotion, stated: StatedDifference | None = None, findings: Items[Finding] = ()) -> str:
    """A short table for a terminal. findings: about the stated poses."""
    seconds, length = float(seconds_of(motion).sum()), float(lengths_m(motion).sum())
    speed, (end_m, end_deg) = length / seconds if seconds else 0.0, end_deviations(motion)
    rows = [
        ("way", f"{length:.2f} m in {seconds:.1f} s, {_steps(motion)}"),
        ("mean speed", f"{speed:.2f} m/s ({KMH * speed:.1f} km/h)"),
        ("end", f"± {end_m:.2f} m, ± {end_deg:.2f}° (standard deviations)"),
        ("not measured", _reasons(motion) or "no step"),
    ]
    if stated is not None:
        rows.append(("stated poses", stated.text()))
        rows += [("", f"{finding.severity}: {finding.line}") for finding in findings]
    return "\n".join([motion.name, aligned(rows, left=(0, 1))])


def to_json(motion: MeasuredMotion, stated: StatedDifference | None = None, findings: Items[Finding] = ()) -> str:
    """The content of report.json. findings: about the stated poses."""
    seconds, length, (end_m, end_deg) = seconds_of(motion), lengths_m(motion), end_deviations(motion)
    comparison = stated and {**stated.to_dict(), "findings": [asdict(finding) for finding in findings]}
    content = {
        "drive": motion.name,
        "length_m": float(length.sum()),
        "duration_s": float(seconds.sum()),
        "mean_speed_m_s": float(length.sum() / seconds.sum()) if len(seconds) else None,
        "end_deviation_m": end_m,
        "end_deviation_deg": end_deg,
        "not_measured": dict(not_measured(motion)),
        "stated": comparison,
        "steps": [_entry(motion, index) for index in range(len(motion.steps))],
    }
    return json.dumps(content, indent=1, ensure_ascii=False)


def _entry(motion: MeasuredMotion, index: int) -> dict[str, Any]:
    step, (first, last) = motion.steps[index], motion.timestamps_ns[index : index + 2].tolist()
    deviations = step.deviations
    return {
        "from_ns": first,
        "to_ns": last,
        "translation_m": step.ego_a_from_ego_b[:3, 3].tolist(),
        "translation_deviation_m": deviations[3:].tolist(),
        "rotation_deg": _turn_deg(step.ego_a_from_ego_b).tolist(),
        "rotation_deviation_deg": np.degrees(deviations[:3]).tolist(),
        "not_measured": step.reason,
        "matches": step.matches,
        "road_points": step.road_points,
    }


def write_report(
    motion: MeasuredMotion, folder: Path, stated: StatedDifference | None = None, findings: Items[Finding] = ()
) -> list[Path]:
    """Write ego_motion.csv and report.json into a folder, made where it is missing. Returns their paths.

    Existing files are overwritten. Raises OutputError.
    """
    report, poses = folder / "report.json", folder / "ego_motion.csv"
    write_whole(report, f"{to_json(motion, stated, findings)}\n".encode(), parents=True)
    write_ego_motion(poses, motion.ego_motion)
    return [poses, report]


MOST_RATE_HZ = 10.0  # a faster drive is measured at this rate: shorter steps cost time and add errors
FASTER = 1.5  # times this rate is thinned to it


def with_measured_motion(drive: Drive, whole: Drive) -> Iterator[tuple[int, int] | DriveView]:
    """The number of steps that are measured and of all, scene by scene; at the end, the drive with that motion.

    A note of each scene states the motion.

    Args:
        drive: the frames that are used.
        whole: a drive with further frames: those between the first and the last one of a scene are measured too.

    Raises InputError where not one step of a scene can be measured.
    """
    motions, notes = dict[str, EgoMotion](), list[str]()
    for scene in dict.fromkeys(stamp.scene for stamp in drive.stamps):
        between = at_most_rate(frames_between(drive, whole, scene))
        steps, total = list[MeasuredStep](), len(between.stamps) - 1
        if total:
            yield 0, total
        for step in measure_steps(between):
            steps.append(step)
            yield len(steps), total
        motion = MeasuredMotion.of(between, steps)
        check_measured(motion)
        motions[scene] = motion.ego_motion
        notes.append(measured_note(motion))
    yield DriveView(drive, motions=motions, notes=tuple(notes))


def frames_between(drive: Drive, whole: Drive, scene: str) -> Drive:
    """The frames of `whole` from the first to the last frame of `drive` in a scene."""
    times = [stamp.timestamp_ns for stamp in drive.stamps if stamp.scene == scene]
    between = [stamp.scene == scene and times[0] <= stamp.timestamp_ns <= times[-1] for stamp in whole.stamps]
    return select(whole, np.flatnonzero(between).tolist())


def at_most_rate(drive: Drive) -> Drive:
    """The drive, thinned to MOST_RATE_HZ where its frames follow each other faster."""
    steps = np.diff([stamp.timestamp_ns for stamp in drive.stamps])
    if not len(steps) or np.median(steps) * FASTER * MOST_RATE_HZ > 1e9:
        return drive
    return select_rate(drive, MOST_RATE_HZ)
