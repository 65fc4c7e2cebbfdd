"""Explanations of implausible poses of cameras and of the bev frame.

Each common mistake is undone in turn (units, inversion, quaternion order, axes). If a plausible pose results, the
mistake is reported, not its consequences.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bevcli.errors import Finding
from bevcli.geometry.cameras import BEV_ORIGIN, Camera
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
    mounting, named = (
        rig_checks.mounting_of(mistake.undo(camera.ego_from_camera)),
        rig_checks.direction_of_name(camera.name),
    )
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
