"""All checks of a sequence: its rig, in their order, and ego-motion (units, jumps, axes).

`input_errors` runs the cheap ones before a run.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from bevcli.errors import Finding, errors_of
from bevcli.frame import Drive, FrameStamp
from bevcli.geometry.cameras import BEV_ORIGIN, Camera, CameraRig
from bevcli.geometry.ego_motion import EgoMotion
from bevcli.geometry.transforms import Array, inverse, quaternion_from_rotation, rigid, rotation_from_quaternion
from bevcli.rig import rig_checks

OTHER_UNIT_M = 30.0  # a longer translation is not in metres
MAX_CM = 790.0  # longer is in millimetres: 0.79 m from the ego origin is common, 7.9 m is not
LEVEL_DEG = (20.0, 10.0)  # largest pitch and roll of a pose after a mistake is undone
NAME_TURN_DEG = 80.0  # largest angle between that pose and the direction in the camera's name
ONE_AXIS_TURN_DEG = 30.0  # the same for a camera that is only tilted or rolled
# Rotation from the axes x right, y down, z forward of a camera to x forward, y left, z up.
BODY_FROM_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True)
class Mistake:
    """A common mistake in a pose, with the texts of its finding.

    undo: the pose as given (4, 4) -> the intended pose.
    """

    code: str
    message: str
    advice: str
    undo: Callable[[Array], Array]


def reordered(pose: Array, shift: int) -> Array:
    """The pose with its quaternion's components rolled by `shift` places; -1 reads w, x, y, z as x, y, z, w."""
    return rigid(pose[:3, 3], rotation_from_quaternion(np.roll(quaternion_from_rotation(pose[:3, :3]), shift)))


NOT_WXYZ = "the quaternion is not in the order w, x, y, z"
MISTAKES = (
    Mistake("transform-inverted", "the transform is camera_from_ego, not ego_from_camera", "invert it", inverse),
    Mistake("quaternion-order", NOT_WXYZ, "put w first", lambda pose: reordered(pose, 1)),
    Mistake("quaternion-order", NOT_WXYZ, "put w first", lambda pose: reordered(pose, -1)),
    Mistake(
        "transform-inverted", "the rotation is inverted, the translation is not", "transpose the rotation",
        lambda pose: rigid(pose[:3, 3], pose[:3, :3].T),
    ),
    Mistake(
        "camera-axes", "the rotation belongs to a frame with x forward, y left, z up, not to a camera frame",
        "multiply it by the rotation to x right, y down, z forward",
        lambda pose: rigid(pose[:3, 3], pose[:3, :3] @ BODY_FROM_OPTICAL),
    ),
)  # fmt: skip


def pose_errors(cameras: Sequence[Camera]) -> list[Finding]:
    """Errors about the poses of single cameras, of which some are implausible."""
    lengths = {camera.name: float(np.linalg.norm(camera.ego_from_camera[:3, 3])) for camera in cameras}
    unit = units_per_metre(max(lengths.values(), default=0.0))  # all wrong translations of a rig share one unit
    units = {name: unit if length > OTHER_UNIT_M else 1.0 for name, length in lengths.items()}
    findings = [_unit_finding(camera, units[camera.name]) for camera in cameras if units[camera.name] != 1]
    posed = ((camera, camera.ego_from_camera, units[camera.name]) for camera in cameras)
    metric = [replace(camera, ego_from_camera=rigid(pose[:3, 3] / unit, pose[:3, :3])) for camera, pose, unit in posed]
    affected, explained, common = _explanations(metric)
    for camera in affected:
        defect, mistake = rig_checks.pose_defects(camera)[0], _best_explanation(camera, explained)
        if common is not None and common not in explained[camera.name] and _explains(common, camera, by_name=False):
            mistake = common  # its name contradicts the corrected pose: a second mistake, see `corrected`
        if mistake is None or (len(affected) == 1 and _is_turned_about_one_axis(camera)):
            findings.append(defect)
        else:
            findings.append(_mistake_finding(camera, mistake, defect))
    return findings


def corrected(cameras: Sequence[Camera]) -> tuple[Camera, ...]:
    """The cameras after undoing the mistake that most of them share, if there is one: for checks of further mistakes.

    Cameras that it does not explain are left out.
    """
    affected, _, common = _explanations(cameras)
    if common is None:
        return ()
    kept = [camera for camera in affected if _explains(common, camera, by_name=False)]
    return tuple(replace(camera, ego_from_camera=common.undo(camera.ego_from_camera)) for camera in kept)


def _explanations(cameras: Sequence[Camera]) -> tuple[list[Camera], dict[str, list[Mistake]], Mistake | None]:
    """The affected cameras, by camera the mistakes that explain it, and the mistake in common.

    That one explains most affected cameras, at least three and more than half of them; None without one.
    """
    affected = [camera for camera in cameras if rig_checks.pose_defects(camera)]
    explained = {camera.name: [m for m in MISTAKES if _explains(m, camera)] for camera in affected}
    counts = {mistake: sum(mistake in of for of in explained.values()) for mistake in MISTAKES}
    best = max(MISTAKES, key=lambda mistake: counts[mistake])
    return affected, explained, best if counts[best] >= 3 and 2 * counts[best] > len(affected) else None


def units_per_metre(length: float) -> float:
    """1, 100 or 1000: whether a translation of this length is in metres, centimetres or millimetres."""
    if length <= OTHER_UNIT_M:
        return 1.0
    return 100.0 if length < MAX_CM else 1000.0


def _explains(mistake: Mistake, camera: Camera, *, by_name: bool = True) -> bool:
    """True if undoing the mistake gives a plausible, level pose that fits the name, or with by_name=False any name."""
    undone = replace(camera, ego_from_camera=mistake.undo(camera.ego_from_camera))
    mounting, named = rig_checks.mounting_of(undone.ego_from_camera), rig_checks.direction_of_name(camera.name)
    level = abs(mounting.pitch_deg) <= LEVEL_DEG[0] and abs(mounting.roll_deg) <= LEVEL_DEG[1]
    fits_name = not by_name or named is None or rig_checks.turn_deg(named, mounting.yaw_deg) <= NAME_TURN_DEG
    return not rig_checks.pose_defects(undone) and level and fits_name


def _is_turned_about_one_axis(camera: Camera) -> bool:
    """True if the camera is only tilted or only rolled: then the defect itself is the best description."""
    codes = [defect.code for defect in rig_checks.pose_defects(camera)]
    right, named = camera.ego_from_camera[:3, 0], rig_checks.direction_of_name(camera.name)
    if codes == ["camera-rolled"]:
        yaw_deg, level = rig_checks.mounting_of(camera.ego_from_camera).yaw_deg, True
    else:
        yaw_deg = float(np.degrees(np.arctan2(right[0], -right[1])))  # independent of pitch, even at 90 degrees
        level = abs(right[2]) <= np.sin(np.radians(LEVEL_DEG[1])) and codes in (["looks-at-ground"], ["looks-at-sky"])
    return bool(level and (named is None or rig_checks.turn_deg(named, yaw_deg) <= ONE_AXIS_TURN_DEG))


def _best_explanation(camera: Camera, explained: Mapping[str, Sequence[Mistake]]) -> Mistake | None:
    """The mistake that explains this camera and the most others; between equals the one that fits this camera best.

    None where it explains fewer than half of the affected cameras, which may be coincidence.
    """
    counts = {mistake: sum(mistake in of for of in explained.values()) for mistake in explained[camera.name]}
    best = max(counts, key=lambda mistake: (counts[mistake], -_misfit(mistake, camera)), default=None)
    return best if best is not None and 2 * counts[best] >= len(explained) else None


def _misfit(mistake: Mistake, camera: Camera) -> float:
    """Pitch, roll and angle to the named direction of the pose after undoing the mistake, summed, degrees."""
    mounting = rig_checks.mounting_of(mistake.undo(camera.ego_from_camera))
    named = rig_checks.direction_of_name(camera.name)
    off_name = 0.0 if named is None else rig_checks.turn_deg(named, mounting.yaw_deg)
    return abs(mounting.pitch_deg) + abs(mounting.roll_deg) + off_name


def _mistake_finding(camera: Camera, mistake: Mistake, defect: Finding) -> Finding:
    undone = rig_checks.mounting_of(mistake.undo(camera.ego_from_camera))
    found = f"{defect.message}, {defect.found}"
    expected = f"level; corrected: height {undone.height:.2f} m, yaw {undone.yaw_deg:.0f}°, "
    expected += f"pitch {undone.pitch_deg:.0f}°"
    return Finding(mistake.code, "error", camera.name, mistake.message, found, expected, mistake.advice)


def _unit_finding(camera: Camera, unit: float) -> Finding:
    name = "millimetres" if unit == 1000 else "centimetres"
    length = np.linalg.norm(camera.ego_from_camera[:3, 3])
    return Finding(
        "translation-unit", "error", camera.name, f"the translation is in {name}",
        f"{length:.0f} m from the ego origin", f"metres, at most {rig_checks.MAX_CAMERA_DISTANCE_M:g}",
        f"divide the translation by {unit:g}",
    )  # fmt: skip


def bev_frame_error(ego_from_bev: Array) -> Finding:
    """The common mistake whose undoing gives a plausible bev frame, or else its implausible property."""
    pose, plausible = ego_from_bev, rig_checks.is_plausible_bev_frame
    distance, height, (tilt, heading) = np.linalg.norm(pose[:3, 3]), pose[2, 3], rig_checks.bev_angles_deg(pose)
    found = f"tilt {tilt:.0f}°, y {heading:.0f}° from forward, height {height:.2f} m"
    expected, unit = f"x right, y forward, z up, z {rig_checks.BEV_HEIGHT_M} m", units_per_metre(float(distance))
    if unit != 1:
        message = f'the translation of "ego_from_bev" is in {"millimetres" if unit == 1000 else "centimetres"}'
        code, found, expected = "translation-unit", f"{distance:.0f} m from the ego origin", f"about {BEV_ORIGIN}"
        advice = f"divide the translation by {unit:g}"
    # KITTI, Waymo and Argoverse have x forward: rotated to x right, such a frame is plausible.
    elif plausible(rigid(pose[:3, 3], pose[:3, :3] @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))):
        code, message = "bev-x-forward", '"ego_from_bev" has x forward'
        found, expected = "x forward, y left", "x right, y forward"
        advice = "rotate it by 90° about z, unless your weights were trained with x forward"
    elif plausible(inverse(pose)):
        code, message, advice = "transform-inverted", '"ego_from_bev" is bev_from_ego, the inverse', "invert it"
    elif plausible(reordered(pose, 1)) or plausible(reordered(pose, -1)):
        code, advice = "quaternion-order", "put w first"
        message = '"ego_from_bev" has a quaternion that is not in the order w, x, y, z'
    # No common mistake explains it.
    elif tilt > rig_checks.TILT_ERROR_DEG:
        code, message, found, expected = "bev-tilted", '"ego_from_bev" is tilted', f"{tilt:.0f}°", "level within 15°"
        advice = "z of the bev frame points up"
    elif abs(heading) > rig_checks.HEADING_DEG:
        code, message, found = "bev-axes", 'y of "ego_from_bev" is not forward', f"y is {heading:.0f}° to the left"
        expected, advice = "x right, y forward", "rotate it about z"
    elif abs(height - rig_checks.BEV_HEIGHT_M) > rig_checks.HEIGHT_ERROR_M:
        code, message = "bev-height", '"ego_from_bev" is not at the height that the weights expect'
        found, expected = f"{height:.2f} m", f"about {rig_checks.BEV_HEIGHT_M} m"
        advice = "give its height above the ground; pillars extend from 4.5 m below this frame to 2.5 m above it"
    else:
        code, message, advice = "bev-far", '"ego_from_bev" is not on the vehicle', "check its translation"
        found = f"{np.hypot(pose[0, 3], pose[1, 3]):.1f} m from the ego origin"
        expected = f"at most {rig_checks.MAX_BEV_DISTANCE_M:g} m"
    return Finding(code, "error", None, message, found, expected, advice)


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
    has_bev = rig_checks.is_plausible_bev_frame(rig.ego_from_bev)
    if any(map(rig_checks.pose_defects, cameras)):
        poses = pose_errors(cameras)
        # Swapped names of cameras whose poses share another mistake, such as all inverted, are seen once it is undone.
        swapped = [
            replace(finding, advice=f"{finding.advice}, after correcting the poses")
            for finding in rig_checks.check_names(corrected(cameras))
            if finding.code == "swapped-names"
        ]
    badly_posed = {finding.camera for finding in poses}
    names = rig_checks.check_names([camera for camera in cameras if camera.name not in badly_posed])
    if None not in wrong:
        if has_bev:
            bev = rig_checks.bev_warnings(rig.ego_from_bev)
        else:
            bev = [bev_frame_error(rig.ego_from_bev)]
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
        (("ego-inverted", "the poses are ego_from_world, the inverse",
          "invert them, or pass `--pose-transform body_from_world`"),
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
        advice = "the ego frame is x forward, y left: rotate the poses into it, or state their axes by `--pose-axes`"
    else:
        return []
    return [Finding(code, "error", None, message, _motion_text(drive), expected, advice)]


def _motion_text(drive: _Drive) -> str:
    headings, tilt = drive.headings_deg, f"tilt {drive.tilt_deg:.0f}°"
    if len(headings) == 0:
        return tilt
    middle = float(np.degrees(np.angle(np.exp(1j * np.radians(headings)).mean())))
    return f"moves {middle:.0f}° from forward over {drive.distance_m:.0f} m, {tilt}"
