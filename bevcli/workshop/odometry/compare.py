"""Stated poses against the measured motion: the mistake that explains their difference; the check of `project-debug`.

Another scale, point, time or direction is undone in turn, and the stated steps then compared with the measured ones in
standard deviations. What fits much better than the poses as they are is named. Where that is nothing, the judge is
asked for another reading of the poses.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import Finding, InputError
from bevcli.frame import Drive
from bevcli.geometry.ego_motion import EgoMotion, derive_kinematics
from bevcli.geometry.transforms import Array, rotation_about_z
from bevcli.printing import counted
from bevcli.sequences.open import DriveView
from bevcli.workshop.formats.pose_readings import Poses, steps_between
from bevcli.workshop.odometry.measure import FREEDOMS, MeasuredMotion, MeasuredStep, MeasuredSteps, measure_steps
from bevcli.workshop.readings.stated import fitting_poses

FEWEST_STEPS = 3  # that are measured
FITS = 5.0  # largest distance of a step that fits, in deviations
UNLIKE = 12.0  # least median distance of a wrong drive, in deviations
MOST = 0.6  # share of the steps that must fit
MUCH = 25.0  # by which the cost of a named mistake is lower, for all steps
SAME = 2.0  # difference of costs that does not count
PARAMETER = 5.0  # cost of a parameter that is estimated
ROUNDS = 8  # of robust estimates
CERTAIN = 4.0  # deviations of a parameter that is told
STANDING_M = 0.05  # a shorter step
SCALE_DEVIATION, LEAST_SCALE, LARGE_SCALE = 0.01, 0.03, 0.2  # of heights over the road; a told one; an error
TURN_DEVIATION, LEAST_TURN, LARGE_TURN = np.radians((0.3, 2.0, 10.0))
LEAST_ORIGIN_M = 0.3
LONGEST_NS, TIME_STEP_NS, LEAST_NS, LARGE_NS = 60 * 10**9, 10**8, 25 * 10**6, 100 * 10**6
FAR_NS, MOST_FAR = 10**9, 0.8  # a larger offset, and the share of the steps that must fit then
COVERED = 0.6  # share of the steps that poses of another time must cover
SEARCHED = 60  # steps for the search of a time
JUMP = 8.0, 0.5, np.radians(2.0)  # a step that is told: deviations, and metres or radians
# How many times too long distances are -> the mistake, and what to do.
SCALES = {
    3.6: ("speeds in km/h were taken for m/s", "divide the distances by 3.6"),
    1 / 3.6: ("speeds in m/s were taken for km/h", "multiply the distances by 3.6"),
    2.23694: ("speeds in mph were taken for m/s", "divide the distances by 2.237"),
    1 / 2.23694: ("speeds in m/s were taken for mph", "multiply the distances by 2.237"),
    1.94384: ("speeds in knots were taken for m/s", "divide the distances by 1.944"),
    3.28084: ("the positions are in feet", "divide them by 3.281"),
    0.3048: ("the positions were taken for feet", "divide them by 0.3048"),
    100.0: ("the positions are in centimetres", "divide them by 100"),
    1000.0: ("the positions are in millimetres", "divide them by 1000"),
    0.001: ("the positions are in kilometres", "multiply them by 1000"),
}


@dataclass(frozen=True)
class _Candidate:
    """Stated steps after something is undone."""

    steps: Array  # (K, 4, 4)
    cost: float  # of them, with that of the estimated parameters
    share: float  # of the used steps that fit
    findings: tuple[Finding, ...] = ()  # what was undone; empty where it is nothing, or too small to be told


def compare(stated: EgoMotion, measured: MeasuredMotion, frames: Sequence[int] | None = None) -> tuple[Finding, ...]:
    """Findings about stated poses that do not fit what the images show.

    One mistake gives one finding, and no finding means that they fit. A finding of severity "info" says that there is
    too little to compare.

    Args:
        stated: the poses of the drive; their times need not be those of the frames.
        measured: the motion between some frames of it.
        frames: numbers of these frames, for texts. Default: 0, 1 and so on.
    """
    shown = MeasuredSteps.of(measured)
    rows = Poses.of(stated)
    poses, covered = rows.at(shown.times_ns)
    shown = replace(shown, is_used=shown.is_used & covered[:-1] & covered[1:])
    if (used := int(shown.is_used.sum())) < FEWEST_STEPS:
        reasons = [step.reason for step in measured.steps if step.reason]
        return (not_compared(f"{counted(used, 'steps')} could be measured" + (f": {reasons[0]}" if reasons else "")),)
    steps = steps_between(poses)
    outcome = as_it_is = _candidate(shown, steps)
    if not _stands(shown, shown.steps):  # else any scale near 0 fits
        fitting = [candidate for candidate in (as_it_is, *_candidates(shown, rows, steps)) if candidate.share >= MOST]
        least = min((candidate.cost for candidate in fitting), default=np.inf)
        best = next((candidate for candidate in fitting if candidate.cost <= least + SAME), as_it_is)
        outcome = best if as_it_is.cost - best.cost > MUCH else as_it_is
    numbers = range(len(shown.times_ns)) if frames is None else frames
    if outcome.share >= MOST:
        return outcome.findings or _jumps(shown, outcome.steps, numbers)
    return (_wrong(shown, steps),)


def not_compared(reason: str) -> Finding:
    """The finding that says why stated poses were not compared with the images."""
    return Finding("motion-not-compared", "info", None, f"the poses were not compared with the images: {reason}")


def _error(code: str, message: str, found: str, expected: str, advice: str, is_error: bool = True) -> Finding:
    return Finding(code, "error" if is_error else "warning", None, message, found, expected, advice)


def _candidate(
    measured: MeasuredSteps,
    steps: Array,
    findings: Iterable[Finding] = (),
    parameters: int = 0,
    distances: Array | None = None,
) -> _Candidate:
    """distances: of the steps, (K,), where they are known."""
    distances = measured.distances(steps) if distances is None else distances
    share = float((distances < FITS)[measured.is_used].mean())
    return _Candidate(steps, float(measured.cost(distances)) + PARAMETER * parameters, share, tuple(findings))


def _candidates(measured: MeasuredSteps, rows: Poses, steps: Array) -> Iterator[_Candidate]:
    """What may be wrong, the likelier first; with another scale too."""
    yield from _scaled(measured, [((), steps)])
    yield _turned(measured, steps)
    yield from _of_another_time(measured, rows)
    yield _of_another_point(measured, steps)
    ends = rows.times_ns[[0, -1]].sum()
    backwards = Poses(ends - rows.times_ns[::-1], rows.rotations[::-1], rows.positions[::-1])
    message, advice = "the poses run backwards in time", "reverse the order of their rows"
    reversed_steps = steps_between(backwards.at(measured.times_ns)[0])
    yield from _scaled(measured, [((_error("motion-reversed", message, "", "", advice),), reversed_steps)])


def _scaled(measured: MeasuredSteps, undone: list[tuple[tuple[Finding, ...], Array]]) -> Iterator[_Candidate]:
    """Each of the N undone steps (K, 4, 4) as it is, and with the scale that fits best."""
    stacked = np.stack([steps for _, steps in undone])
    covariances = np.linalg.inv(measured.precisions)
    precisions, moved = np.linalg.inv(covariances[:, 3:, 3:]), measured.steps[:, :3, 3]
    along = np.einsum("nki,kij,kj->nk", stacked[..., :3, 3], precisions, moved)
    length = np.einsum("nki,kij,nkj->nk", stacked[..., :3, 3], precisions, stacked[..., :3, 3]) + 1e-12
    scales = np.median((along / length)[:, measured.is_used], axis=1)  # to undo it
    for _ in range(ROUNDS):
        residuals = scales[:, None, None] * stacked[..., :3, 3] - moved
        squared = np.einsum("nki,kij,nkj->nk", residuals, precisions, residuals)
        weights = measured.weights(squared)
        scales = (weights * along).sum(1) / (weights * length).sum(1)
    deviations = np.sqrt(np.maximum((weights * squared).sum(1) / (3 * weights.sum(1)), 1) / (weights * length).sum(1))
    longer = stacked.copy()
    longer[..., :3, 3] *= scales[:, None, None]
    far, far_longer = measured.distances(stacked), measured.distances(longer)
    for index, (findings, steps) in enumerate(undone):
        scale, deviation = float(scales[index]), float(deviations[index])
        if findings:
            yield _candidate(measured, steps, findings, 0, far[index])
        if scale > 0:
            told = (*findings, *_scale_finding(1 / scale, deviation / scale**2))
            yield _candidate(measured, longer[index], told, 1, far_longer[index])


def _scale_finding(factor: float, deviation: float) -> tuple[Finding, ...]:
    """factor: how many times too long the stated distances are."""
    deviation = float(np.hypot(deviation, SCALE_DEVIATION * factor))
    if abs(factor - 1) < max(LEAST_SCALE, CERTAIN * deviation):
        return ()
    digits = 2 if factor > 0.1 else 5
    description = f"{factor:.{digits}f} ± {deviation:.{digits}f} times as long as the images show"
    near = min(SCALES, key=lambda scale: abs(np.log(scale / factor)))
    if abs(np.log(near / factor)) < max(LEAST_SCALE, 3 * deviation / factor):
        message, advice = SCALES[near]
        return (_error("motion-scale", message, description, "1", advice),)
    advice = f"correct a wheel radius or a unit by {1 / factor:.3f}, or the heights of the cameras by {factor:.3f}"
    message = "the poses have another scale than the images"
    return (_error("motion-scale", message, description, "1", advice, abs(factor - 1) > LARGE_SCALE),)


def _turned(measured: MeasuredSteps, steps: Array) -> _Candidate:
    """The vehicle frame of the poses turned about z, by any angle."""
    lengths = (steps[:, :2, 3] ** 2).sum(1)
    across = np.linalg.inv(measured.precisions)[:, 4, 4]
    turn, undone, weights = 0.0, steps, measured.is_used / across
    for _ in range(ROUNDS):
        turn = turn_between(steps, measured.steps, weights)
        rotation = rotation_about_z(turn)
        undone = steps.copy()
        undone[:, :3, 3] = steps[:, :3, 3] @ rotation.T
        undone[:, :3, :3] = rotation @ steps[:, :3, :3] @ rotation.T
        weights = measured.weights(measured.distances(undone) ** 2) / across
    deviation = float(np.hypot(1 / np.sqrt((weights * lengths).sum() + 1e-12), TURN_DEVIATION))
    if abs(turn) < max(LEAST_TURN, CERTAIN * deviation):
        return _candidate(measured, undone, parameters=1)
    side = "left" if turn > 0 else "right"
    description = f"x points {np.degrees(abs(turn)):.1f}° ± {np.degrees(deviation):.1f}° to the {side} of forward"
    message, advice = "x of the poses is not forward", "turn their rotations about z, or check the cameras' yaw"
    finding = _error("motion-axes", message, description, "x forward", advice, abs(turn) > LARGE_TURN)
    return _candidate(measured, undone, (finding,), 1)


def turn_between(steps: Array, measured: Array, weights: Array) -> float:
    """The angle about z, radians, from the translations of steps (K, 4, 4) to the measured ones; weights: (K,)."""
    flat, shown = (motion[:, 0, 3] + 1j * motion[:, 1, 3] for motion in (steps, measured))
    return float(np.angle((weights * shown * flat.conj()).sum()))


def _of_another_point(measured: MeasuredSteps, steps: Array) -> _Candidate:
    """The poses are those of another point of the vehicle than the ego origin."""
    # Steps between poses of the point p of the ego frame have the translation t + (R - 1) p.
    slopes = (steps[:, :3, :3] - np.eye(3))[:, :, :2]  # (K, 3, 2)
    precisions = measured.precisions[:, 3:, 3:]
    off = steps[:, :3, 3] - measured.steps[:, :3, 3]
    undone, weights, point, information = steps, measured.is_used / 1, np.zeros(2), np.eye(2)
    for _ in range(ROUNDS):
        information = np.einsum("k,kai,kab,kbj->ij", weights, slopes, precisions, slopes) + 1e-9 * np.eye(2)
        point = np.linalg.solve(information, np.einsum("k,kai,kab,kb->i", weights, slopes, precisions, off))
        undone = steps.copy()
        undone[:, :3, 3] = steps[:, :3, 3] - slopes @ point
        weights = measured.weights(measured.distances(undone) ** 2)
    deviations = np.sqrt(np.diag(np.linalg.inv(information)))
    if not (np.abs(point) > np.maximum(LEAST_ORIGIN_M, CERTAIN * deviations)).any():
        return _candidate(measured, undone, parameters=2)
    (x, y), (dx, dy) = point.tolist(), deviations.tolist()
    description = f"x {x:+.2f} ± {dx:.2f} m, y {y:+.2f} ± {dy:.2f} m from it"
    message = "the poses are those of another point of the vehicle than the origin of the calibration"
    advice = "give both for the same point, on the ground below the centre of the rear axle"
    finding = _error("motion-origin", message, description, "the ego origin", advice, is_error=False)
    return _candidate(measured, undone, (finding,), 2)


def _of_another_time(measured: MeasuredSteps, rows: Poses) -> Iterator[_Candidate]:
    """The poses of another time, as they are and with another scale."""
    offset = _time_offset(measured, rows)
    if offset is None:
        return
    around = offset + np.array([-1, 0, 1]) * (TIME_STEP_NS // 20)
    poses, covered = rows.at(measured.times_ns + around[:, None])
    steps = steps_between(poses)
    covered = covered[1]
    there = replace(measured, is_used=measured.is_used & covered[:-1] & covered[1:])
    slopes = (there.differences(steps[2]) - there.differences(steps[0])) / (2 * TIME_STEP_NS // 20)
    squared = there.squared(there.differences(steps[1]))
    weights = there.weights(squared)
    information = (weights * there.squared(slopes)).sum() + 1e-30
    deviation = float(np.sqrt(max(1.0, (weights * squared).sum() / (FREEDOMS * weights.sum())) / information))
    findings: tuple[Finding, ...] = ()
    if abs(offset) > max(LEAST_NS, CERTAIN * deviation):
        word = "late" if offset > 0 else "early"
        description = f"their times are {abs(offset) / 1e6:.0f} ± {deviation / 1e6:.0f} ms too {word}"
        message, advice = "the poses are of another time than the images", "correct the times of the poses or frames"
        findings = (_error("motion-time", message, description, "0 ms", advice, abs(offset) >= LARGE_NS),)
    far = abs(offset) >= FAR_NS
    # The cost of all steps from that of the covered ones; that of two parameters, as it is the best of many times.
    cost_factor = measured.is_used.sum() / there.is_used.sum()
    for candidate in (_candidate(there, steps[1]), *_scaled(there, [((), steps[1])])):
        share = candidate.share if not far or candidate.share >= MOST_FAR else 0.0
        told = (*findings, *candidate.findings)
        yield replace(candidate, cost=candidate.cost * cost_factor + 2 * PARAMETER, share=share, findings=told)


def _time_offset(measured: MeasuredSteps, rows: Poses) -> int | None:
    """The time to add to those of the frames at which the poses fit best, nanoseconds; None without other times."""
    indices = np.flatnonzero(measured.is_used)[:SEARCHED]
    times_ns = np.stack([measured.times_ns[indices], measured.times_ns[indices + 1]], axis=-1)  # (K, 2)
    few = replace(
        measured, steps=measured.steps[indices], precisions=measured.precisions[indices],
        is_used=np.ones(len(indices), dtype=bool),
    )  # fmt: skip
    best, step = 0, TIME_STEP_NS
    offsets = np.arange(-LONGEST_NS, LONGEST_NS + 1, step)
    while step >= TIME_STEP_NS // 100:
        reached = times_ns + offsets[:, None, None]
        within = ((reached >= rows.times_ns[0]) & (reached <= rows.times_ns[-1])).all(-1)
        offsets = offsets[within.mean(1) >= COVERED]
        if not len(offsets):
            return None
        poses, covered = rows.at(times_ns + offsets[:, None, None])
        # The poses outside of the rows are not steps.
        costs = few.cost(few.distances(steps_between(poses)[..., 0, :, :]), np.asarray(covered.all(-1)))
        best = int(offsets[costs.argmin()])
        offsets, step = best + np.arange(-10, 11) * (step // 10), step // 10
    return best


def _wrong(measured: MeasuredSteps, steps: Array) -> Finding:
    """The finding where nothing fits: one of both stands still, or the poses are those of another drive."""
    used = measured.is_used
    fits = int((measured.distances(steps) < FITS)[used].sum())
    stated_m, shown_m = (np.linalg.norm(motion[used, :3, 3], axis=1) for motion in (steps, measured.steps))
    code, both = "motion-stands", f"{stated_m.sum():.1f} m in the poses, {shown_m.sum():.1f} m in the images"
    if _stands(measured, steps):
        message, advice = "the poses stand still, but the images move", "give the poses of the drive, or measure them"
        return _error(code, message, both, "equal", advice)
    if _stands(measured, measured.steps):
        advice = "take poses and images of the same drive and time"
        return _error(code, "the poses move, but the images stand still", both, "equal", advice)
    if np.median(measured.distances(steps)[used]) < UNLIKE:
        return not_compared(f"{fits} of {int(used.sum())} steps fit, and no common mistake explains the others")
    message = "the poses do not fit the images, and no common mistake explains it"
    advice = "take the poses of this drive, or check the cameras' poses"
    description = f"{fits} of {int(used.sum())} steps fit; {both}"
    return _error("motion-wrong-drive", message, description, "all steps fit", advice)


def _stands(measured: MeasuredSteps, steps: Array) -> bool:
    return bool(np.median(np.linalg.norm(steps[measured.is_used, :3, 3], axis=1)) < STANDING_M)


def _jumps(measured: MeasuredSteps, steps: Array, frames: Sequence[int]) -> tuple[Finding, ...]:
    """The finding about single steps that do not fit, and that are not smooth either, where the measured ones are."""
    deviations, metres, radians = JUMP
    off = measured.differences(steps)
    large = (np.linalg.norm(off[:, 3:5], axis=1) > metres) | (np.abs(off[:, 2]) > radians)
    is_jump = measured.is_used & large & (measured.distances(steps) > deviations)
    is_jump &= _roughness(measured.times_ns, steps) > 2 * _roughness(measured.times_ns, measured.steps)
    jumps = np.flatnonzero(is_jump)
    if not len(jumps):
        return ()
    between = ", ".join(f"{frames[index]} and {frames[index + 1]}" for index in jumps[:5])
    more = f" and {len(jumps) - 5} more" if len(jumps) > 5 else ""
    worst = jumps[np.linalg.norm(off[jumps, 3:5], axis=1).argmax()]
    distance, turn_deg = np.linalg.norm(off[worst, 3:5]), np.degrees(abs(off[worst, 2]))
    description = f"between frames {between}{more}; {distance:.1f} m, {turn_deg:.1f}°"
    message, advice = "the poses jump, and the images do not", "correct these poses, or leave the frames out"
    return (_error("motion-jumps", message, description, "as the images show", advice),)


def _roughness(times_ns: NDArray[np.int64], steps: Array) -> Array:
    """(K,) change of velocity from the steps before and after, m/s; of yaw rate too, a radian as ten metres."""
    seconds = np.diff(times_ns)[:, None] / 1e9
    yaws = np.arctan2(steps[:, 1, 0], steps[:, 0, 0])
    rates = np.column_stack([steps[:, 0, 3], steps[:, 1, 3], 10 * yaws]) / seconds
    padded = np.concatenate([rates[1:2], rates, rates[-2:-1]])
    return np.linalg.norm(rates - (padded[:-2] + padded[2:]) / 2, axis=1)


STEPS = 8  # that are measured
BETWEEN_NS = 400_000_000  # between two frames
UNEXPLAINED = "motion-wrong-drive", "motion-not-compared", "motion-jumps", "motion-time", "motion-origin"
MOST_TURN, MOVES_M, MOVING = 0.3, 0.5, 0.05  # what a step tells: its turn up to this, radians; and that it moves


def stated_motion_findings(drive: Drive, steps: int = STEPS) -> tuple[Finding, ...]:
    """Findings about the stated poses of a drive, from a few measured steps; none for a drive without poses."""
    *_, findings = stated_motion_steps(drive, steps)
    return findings or ()


def stated_motion_steps(drive: Drive, steps: int = STEPS) -> Iterator[tuple[Finding, ...] | None]:
    """`stated_motion_findings`: None after each measured step, then the findings."""
    if not drive.has_ego_motion:
        yield ()
        return
    some, measured = DriveView(drive, chosen_frames(drive, steps)), list[MeasuredStep]()
    try:
        for step in measure_steps(some):
            measured.append(step)
            yield None
    except InputError as error:
        yield (not_compared(str(error)),)
        return
    stated, motion = stated_poses(some), MeasuredMotion.of(some, measured)
    numbers = [stamp.index for stamp in some.stamps]
    findings = compare(stated, motion, numbers)
    if any(finding.code in UNEXPLAINED for finding in findings) and (found := fitting_poses(some, stated)):
        reading, undone = found
        findings = (reading, *(each for each in compare(undone, motion, numbers) if each.code not in UNEXPLAINED))
    yield findings


def stated_poses(drive: Drive) -> EgoMotion:
    """The poses of a drive: in its table, or of its frames."""
    if drive.ego_motion is not None:
        return drive.ego_motion
    times = np.array([stamp.timestamp_ns for stamp in drive.stamps], dtype=np.int64)
    poses = [drive.ground_truth_frame(index).world_from_ego for index in range(len(times))]
    rows = times, np.stack([pose.translation for pose in poses]), np.stack([pose.quaternion for pose in poses])
    return EgoMotion(*rows, *derive_kinematics(*rows), velocities_are_stated=False)


def chosen_frames(drive: Drive, steps: int = STEPS) -> list[int]:
    """The indices of at most steps + 1 frames of the longest scene, those between which the poses turn most."""
    times = [stamp.timestamp_ns for stamp in drive.stamps]
    scenes = [list(scene) for _, scene in groupby(range(len(times)), lambda index: drive.stamps[index].scene)]
    indices: list[int] = []
    for index in max(scenes, key=len, default=[]):
        if not indices or times[index] - times[indices[-1]] >= BETWEEN_NS:
            indices.append(index)
    starts = len(indices) - steps
    if starts <= 1:
        return indices
    worth = np.zeros(len(indices) - 1)
    if drive.ego_motion is not None:
        poses, _ = Poses.of(drive.ego_motion).at(np.array([times[index] for index in indices]))
        moves = steps_between(poses)
        turns = np.abs(np.arctan2(moves[:, 1, 0], moves[:, 0, 0]))
        worth = np.minimum(turns, MOST_TURN) + MOVING * (np.linalg.norm(moves[:, :3, 3], axis=1) > MOVES_M)
    sums = np.convolve(worth, np.ones(steps), mode="valid")
    start = int(sums.argmax()) if np.ptp(sums) > 0 else starts // 2
    return indices[start : start + steps + 1]


def without_consequences(
    motion: tuple[Finding, ...], calibration: tuple[Finding, ...], cameras: int
) -> tuple[Finding, ...]:
    """The findings about poses, none of them an error, and about the calibration measured with them: one cause each.

    A small difference, such as a scale, may come from single cameras that are off: it is taken for that where fewer
    than half of the cameras are. If nothing could be measured, the calibration says why.
    """
    off = [finding for finding in calibration if finding.code == "calibration-off"]
    if any(finding.severity == "warning" for finding in motion):
        return calibration if 0 < len(off) < cameras / 2 else motion
    is_measured = any(finding.severity != "info" for finding in calibration) or not calibration
    return (*motion, *calibration) if is_measured else calibration
