"""All checks of a sequence: its rig, in their order, and ego-motion (units, jumps, axes).

`input_errors` runs the cheap ones before a run.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from bevcli.errors import Finding, errors_of
from bevcli.frame import Drive, FrameStamp
from bevcli.geometry.cameras import BEV_ORIGIN, Camera, CameraRig
from bevcli.geometry.ego_motion import EgoMotion
from bevcli.geometry.transforms import Array, rotation_from_quaternion
from bevcli.rig import rig_checks

BEV_ASSUMED = Finding(
    "bev-assumed", "info", None, 'the calibration has no "ego_from_bev"',
    advice=f"the default is used: a level frame at {BEV_ORIGIN}, x right, y forward",
)  # fmt: skip
MERGED_FROM = 3  # cameras with the same mistake: from this many on it is one finding on the whole rig
MAX_SPEED = 70.0  # m/s, 250 km/h
MIN_MOVING_SPEED = 1.0  # m/s; at lower speeds the direction of motion is noise
SPEED_FACTOR = 1.3  # largest ratio of the stated speed to the speed from the poses
MAX_TILT_DEG = 20.0
FORWARD_DEG = 45.0
MOST_STEPS = 0.8  # share of the steps that counts as the whole drive
MIN_DISTANCE_M = 5.0  # on shorter drives the direction of motion is not checked
JUMP_FACTOR = 5.0  # a step this much faster than the median is a jump
CHECKED_POSES = 5000  # before a run: of a longer drive, every second, third, … pose is checked


def input_errors(drive: Drive, source: str = "SEQUENCE") -> tuple[str, ...]:
    """One line for each mistake in a drive's rig and ego-motion that is seen without images and BEV grid.

    source: the drive's path, for the command that each line names.
    """
    findings = errors_of(rig_findings(drive.rig))
    motion, stamps = drive.ego_motion, drive.stamps
    if motion is not None and stamps:
        times = motion.timestamps_ns
        during = np.flatnonzero((times >= stamps[0].timestamp_ns) & (times <= stamps[-1].timestamp_ns))
        checked = during[:: 1 + len(during) // CHECKED_POSES]
        findings += errors_of(check_scenes(motion.of_rows(checked), stamps))
    first = {(finding.code, finding.camera): finding for finding in reversed(findings)}  # scenes repeat a mistake
    return tuple(
        f"error in the input: {finding.line}; `bevcli project-debug {source}` says more"
        for finding in reversed(first.values())
    )


def rig_findings(rig: CameraRig, found_before: Sequence[Finding] = ()) -> list[Finding]:
    """All findings about a rig but those about coverage and the comparison with nuScenes.

    found_before: from reading the file. Consequences of a reported error are suppressed: a camera with an error from
    reading is not checked again, and names are compared only for cameras with plausible poses.
    """
    poses, swapped, bev = list[Finding](), list[Finding](), list[Finding]()
    wrong = {finding.camera for finding in errors_of(found_before)}
    cameras = [camera for camera in rig.cameras if camera.name not in wrong]
    has_defects, has_bev = (
        any(map(rig_checks.pose_defects, cameras)),
        rig_checks.is_plausible_bev_frame(rig.ego_from_bev),
    )
    if has_defects or not has_bev:
        from bevcli.rig import mistakes  # explains what a sound rig does not have
    if has_defects:
        poses = mistakes.pose_errors(cameras)
        # Swapped names of cameras whose poses share another mistake, such as all inverted, are seen once it is undone.
        swapped = [
            replace(finding, advice=f"{finding.advice}, after correcting the poses")
            for finding in rig_checks.check_names(mistakes.corrected(cameras))
            if finding.code == "swapped-names"
        ]
    badly_posed = {finding.camera for finding in poses}
    names = rig_checks.check_names([camera for camera in cameras if camera.name not in badly_posed])
    if None not in wrong:
        if has_bev:
            bev = rig_checks.bev_warnings(rig.ego_from_bev)
        else:
            bev = [mistakes.bev_frame_error(rig.ego_from_bev)]
    if rig.ego_from_bev_assumed:
        bev.append(BEV_ASSUMED)
    return [*found_before, *_merged([*poses, *rig_checks.check_lenses(cameras)], cameras), *names, *swapped, *bev]


def _merged(findings: Sequence[Finding], cameras: Sequence[Camera]) -> list[Finding]:
    """Findings with the same code and message on three or more cameras, or on all of several, become one on the rig."""
    groups: dict[tuple[str, str], list[Finding]] = {}
    for finding in findings:
        groups.setdefault((finding.code, finding.message), []).append(finding)
    merged: list[Finding] = []
    for group in groups.values():
        if len(group) >= MERGED_FROM or len(group) == len(cameras) > 1:
            names = ", ".join(str(finding.camera) for finding in group)
            found = f"{group[0].camera}: {group[0].found}"
            merged.append(replace(group[0], camera=None, message=f"{group[0].message} ({names})", found=found))
        else:
            merged += group
    return merged


@dataclass(frozen=True)
class _Drive:
    """T poses of a drive, two or more."""

    rotations: Array  # (T, 3, 3), world_from_ego
    steps: Array  # (T-1, 3), from each pose to the next, metres in the world frame
    seconds: Array  # (T-1,), duration of each step
    speeds: Array  # (T-1,), speed from pose to pose, m/s
    distance_m: float  # distance driven, steps below the moving speed left out
    headings_deg: Array  # (M,), direction of each step with motion, counter-clockwise from ego x; empty: a short drive
    tilt_deg: float  # median angle between z of the ego frame and z of the world frame
    is_plausible: bool  # the vehicle is level, not too fast, and drives forward in most steps

    @classmethod
    def of(cls, ego_motion: EgoMotion) -> "_Drive":
        """The poses of ego-motion."""
        rotations = rotation_from_quaternion(ego_motion.quaternions)
        steps, seconds = np.diff(ego_motion.translations, axis=0), np.diff(ego_motion.timestamps_ns) / 1e9
        distances = np.linalg.norm(steps, axis=1)
        speeds = distances / seconds
        distance_m = float(distances[speeds > MIN_MOVING_SPEED].sum())
        moving = (speeds > MIN_MOVING_SPEED) & (distance_m >= MIN_DISTANCE_M)
        ego_steps = np.einsum("tji,tj->ti", rotations[:-1], steps)[moving]
        headings_deg = np.degrees(np.arctan2(ego_steps[:, 1], ego_steps[:, 0]))
        tilt_deg = float(np.degrees(np.median(np.arccos(np.clip(rotations[:, 2, 2], -1, 1)))))
        ahead = len(headings_deg) == 0 or (np.abs(headings_deg) <= FORWARD_DEG).mean() >= MOST_STEPS
        is_plausible = bool(tilt_deg <= MAX_TILT_DEG and np.median(speeds) <= MAX_SPEED and ahead)
        return cls(rotations, steps, seconds, speeds, distance_m, headings_deg, tilt_deg, is_plausible)


def check_ego_motion(ego_motion: EgoMotion) -> tuple[Finding, ...]:
    """Findings about the poses of one scene, or else about its stated velocities; none for a single row."""
    if len(ego_motion.timestamps_ns) < 2:
        return ()
    drive = _Drive.of(ego_motion)
    cause = None if drive.is_plausible else _mistake(drive, ego_motion) or _units(drive)
    if cause is not None:
        return (cause,)
    findings, speeds = [], drive.speeds
    jumps = np.flatnonzero((speeds > MAX_SPEED) & (speeds > JUMP_FACTOR * np.median(speeds)))
    if len(jumps):
        first = int(jumps[0])
        found = f"{len(jumps)} of {len(speeds)} steps; {np.linalg.norm(drive.steps[first]):.1f} m in "
        found += f"{drive.seconds[first]:.2f} s at {int(ego_motion.timestamps_ns[first + 1])} ns"
        message, advice = "the vehicle's position jumps", "start a new scene there, or correct the poses"
        findings.append(Finding("ego-jump", "error", None, message, found, f"at most {MAX_SPEED:g} m/s", advice))
    findings += _direction(drive)
    moving = speeds > MIN_MOVING_SPEED
    if not findings and ego_motion.velocities_are_stated and moving.any():
        stated_speeds = np.linalg.norm((ego_motion.velocities[:-1] + ego_motion.velocities[1:]) / 2, axis=1)[moving]
        if not 1 / SPEED_FACTOR <= float(np.median(stated_speeds / speeds[moving])) <= SPEED_FACTOR:
            found = f"stated {np.median(stated_speeds):.1f} m/s, from the poses {np.median(speeds[moving]):.1f} m/s"
            message, advice = "the stated speed does not fit the poses", "give vx, vy, vz in m/s, or leave them out"
            expected = f"equal within a factor of {SPEED_FACTOR:g}"
            findings.append(Finding("ego-speed", "error", None, message, found, expected, advice))
    return tuple(findings)


def check_scenes(ego_motion: EgoMotion, stamps: Sequence[FrameStamp]) -> tuple[Finding, ...]:
    """Findings of `check_ego_motion` about each scene of a drive: cut midway between frames of different scenes."""
    changes = [(a.timestamp_ns + b.timestamp_ns) // 2 for a, b in pairwise(stamps) if a.scene != b.scene]
    times = ego_motion.timestamps_ns
    rows = np.split(np.arange(len(times)), np.searchsorted(times, np.sort(np.array(changes, dtype=np.int64))))
    return tuple(f for scene in rows if len(scene) > 1 for f in check_ego_motion(ego_motion.of_rows(scene)))


def _units(drive: _Drive) -> Finding | None:
    """Translations in millimetres or timestamps in another unit than nanoseconds make every step too fast."""
    median = float(np.median(drive.speeds))
    if median <= MAX_SPEED:
        return None
    advice = "give metres and nanoseconds; a speed that is wrong by 1000 or 1000000 shows which unit is wrong"
    found, expected = f"median {median:.0f} m/s", f"at most {MAX_SPEED:g} m/s"
    message = "the vehicle is impossibly fast in most steps: wrong unit of timestamps or translations"
    return Finding("ego-units", "error", None, message, found, expected, advice)


def _mistake(drive: _Drive, ego_motion: EgoMotion) -> Finding | None:
    """The common mistake whose undoing gives a plausible drive."""
    quaternions = ego_motion.quaternions
    inverted = -np.einsum("tji,tj->ti", drive.rotations, ego_motion.translations)
    order = ("ego-quaternion-order", "the quaternions are not in the order w, x, y, z", "put qw first")
    for (code, message, advice), undone in (
        (order, replace(ego_motion, quaternions=np.roll(quaternions, 1, axis=1))),
        (order, replace(ego_motion, quaternions=np.roll(quaternions, -1, axis=1))),
        (("ego-inverted", "the poses are ego_from_world, the inverse", "invert them"),
         replace(ego_motion, translations=inverted, quaternions=quaternions * [1, -1, -1, -1])),
    ):  # fmt: skip
        if _Drive.of(undone).is_plausible:
            return Finding(code, "error", None, message, _motion_text(drive), "level, driving forward", advice)
    return None


def _direction(drive: _Drive) -> list[Finding]:
    """A tilted ego frame, or driving sideways or backwards in most steps."""
    headings = drive.headings_deg
    ahead = float((np.abs(headings) <= FORWARD_DEG).mean()) if len(headings) else 1.0
    back = float((np.abs(headings) >= 180 - FORWARD_DEG).mean()) if len(headings) else 0.0
    if drive.tilt_deg > MAX_TILT_DEG:
        code, message, expected = "ego-tilted", "the ego frame is tilted in the world", "level"
        advice = "z of the ego frame and of the world frame point up: check the axes"
    elif back >= MOST_STEPS:
        code, message, expected = "ego-backwards", "the vehicle drives backwards", "forward"
        advice = "x of the ego frame is forward: rotate the poses by 180° about z, unless the whole drive is in reverse"
    elif 1 - ahead - back >= MOST_STEPS:
        code, message, expected = "ego-sideways", "the vehicle drives sideways", "forward"
        advice = "the ego frame is x forward, y left: rotate the poses into it"
    else:
        return []
    return [Finding(code, "error", None, message, _motion_text(drive), expected, advice)]


def _motion_text(drive: _Drive) -> str:
    headings, tilt = drive.headings_deg, f"tilt {drive.tilt_deg:.0f}°"
    if len(headings) == 0:
        return tilt
    middle = float(np.degrees(np.angle(np.exp(1j * np.radians(headings)).mean())))
    return f"moves {middle:.0f}° from forward over {drive.distance_m:.0f} m, {tilt}"
