"""Checks of camera poses. The mistake that explains an implausible pose is found by undoing it.

A pose is implausible if the camera is far from the vehicle, under the ground, looks at the ground or the sky, or is
rolled. Then each common mistake is undone in turn (units, inversion, quaternion order, axes). If a plausible pose
results, the mistake is reported, not its consequences.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bevcli.findings import Finding
from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array, inverse, quaternion_from_rotation, rigid, rotation_from_quaternion
from bevcli.rig.mounting import mounting_of, seen_fov_deg
from bevcli.rig.name_checks import direction_of_name, turn_deg

MAX_DISTANCE_M = 15.0  # from the ego origin; the rear end of a bus or a lorry
OTHER_UNIT_M = 30.0  # a longer translation is not in metres
MAX_CM = 790.0  # longer is in millimetres: 0.79 m from the ego origin is common, 7.9 m is not
HEIGHTS_M = (0.15, 5.0)  # from a bumper to the roof of a lorry
MAX_PITCH_DEG = 30.0  # beyond it, and without the horizon in the image, a camera looks at the ground or the sky
MAX_ROLL_DEG = 30.0
LEVEL_DEG = (20.0, 10.0)  # largest pitch and roll of a pose after a mistake is undone
NAME_TURN_DEG = 80.0  # largest angle between that pose and the direction in the camera's name
ONE_AXIS_TURN_DEG = 30.0  # the same for a camera that is only tilted or rolled
# Rotation from the axes x right, y down, z forward of a camera to x forward, y left, z up.
BODY_FROM_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True)
class Mistake:
    """A common mistake in a pose.

    Attributes:
        code: of the finding.
        message: of the finding.
        advice: of the finding.
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


def check_poses(cameras: Sequence[Camera]) -> tuple[Finding, ...]:
    """Errors about the poses of single cameras; none where every pose is plausible."""
    lengths = {camera.name: float(np.linalg.norm(camera.ego_from_camera[:3, 3])) for camera in cameras}
    unit = units_per_metre(max(lengths.values(), default=0.0))  # all wrong translations of a rig share one unit
    units = {name: unit if length > OTHER_UNIT_M else 1.0 for name, length in lengths.items()}
    findings = [_unit_finding(camera, units[camera.name]) for camera in cameras if units[camera.name] != 1]
    metric = [_in_metres(camera, units[camera.name]) for camera in cameras]
    affected = [camera for camera in metric if _defects(camera)]
    explained = {camera.name: [m for m in MISTAKES if _explains(m, camera)] for camera in affected}
    common = _common_mistake(affected, explained)
    for camera in affected:
        defect, mistake = _defects(camera)[0], _best_explanation(camera, explained)
        if common is not None and common not in explained[camera.name] and _explains(common, camera, by_name=False):
            mistake = common  # its name contradicts the corrected pose: a second mistake, see `corrected`
        if mistake is None or (len(affected) == 1 and _is_turned_about_one_axis(camera)):
            findings.append(defect)
        else:
            findings.append(_mistake_finding(camera, mistake, defect))
    return tuple(findings)


def corrected(cameras: Sequence[Camera]) -> tuple[Camera, ...]:
    """The cameras after undoing the mistake that most of them share, if there is one: for checks of further mistakes.

    Cameras that it does not explain are left out.
    """
    affected = [camera for camera in cameras if _defects(camera)]
    explained = {camera.name: [m for m in MISTAKES if _explains(m, camera)] for camera in affected}
    common = _common_mistake(affected, explained)
    if common is None:
        return ()
    kept = [camera for camera in affected if _explains(common, camera, by_name=False)]
    return tuple(replace(camera, ego_from_camera=common.undo(camera.ego_from_camera)) for camera in kept)


def _common_mistake(affected: Sequence[Camera], explained: Mapping[str, Sequence[Mistake]]) -> Mistake | None:
    """The mistake that explains most affected cameras, at least three and more than half of them; None without one."""
    counts = {mistake: sum(mistake in of for of in explained.values()) for mistake in MISTAKES}
    best = max(MISTAKES, key=lambda mistake: counts[mistake])
    return best if counts[best] >= 3 and 2 * counts[best] > len(affected) else None


def units_per_metre(length: float) -> float:
    """1, 100 or 1000: whether a translation of this length is in metres, centimetres or millimetres."""
    if length <= OTHER_UNIT_M:
        return 1.0
    return 100.0 if length < MAX_CM else 1000.0


def _in_metres(camera: Camera, unit: float) -> Camera:
    """The camera with its translation divided by `unit`."""
    pose = rigid(camera.ego_from_camera[:3, 3] / unit, camera.ego_from_camera[:3, :3])
    return replace(camera, ego_from_camera=pose)


def _defects(camera: Camera) -> list[Finding]:
    """What is implausible about a pose, the most severe first."""
    mounting, name = mounting_of(camera.ego_from_camera), camera.name
    low, high = HEIGHTS_M
    defects = []
    if mounting.horizontal_distance > MAX_DISTANCE_M:
        found = f"{mounting.horizontal_distance:.1f} m from the ego origin"
        defects.append(_defect("camera-far", name, "is not on the vehicle", found, f"at most {MAX_DISTANCE_M:g} m"))
    if not low <= mounting.height <= high:
        found, expected = f"{mounting.height:.2f} m", f"{low:g} to {high:g} m above the ground"
        advice = "the ego origin is on the ground, under the rear axle"
        defects.append(_defect("camera-height", name, "has an implausible height", found, expected, advice))
    if abs(mounting.pitch_deg) > max(MAX_PITCH_DEG, seen_fov_deg(camera)[1] / 2):
        where = "ground" if mounting.pitch_deg < 0 else "sky"
        found, expected = f"pitch {mounting.pitch_deg:.0f}°", "the horizon in the image"
        defects.append(_defect(f"looks-at-{where}", name, f"looks at the {where}", found, expected))
    elif abs(mounting.roll_deg) > MAX_ROLL_DEG:
        message = "is upside down" if abs(mounting.roll_deg) > 150 else "is rolled about its viewing direction"
        found, advice = f"roll {mounting.roll_deg:.0f}°", "check the camera's pose; a quaternion has w first"
        defects.append(_defect("camera-rolled", name, message, found, f"within {MAX_ROLL_DEG:g}°", advice))
    return defects


def _defect(
    code: str, name: str, message: str, found: str, expected: str, advice: str = "check the camera's pose"
) -> Finding:
    return Finding(code, "error", name, message, found, expected, advice)


def _explains(mistake: Mistake, camera: Camera, *, by_name: bool = True) -> bool:
    """Whether undoing the mistake gives a plausible, level pose that fits the camera's name.

    by_name: whether it has to fit the name.
    """
    undone = replace(camera, ego_from_camera=mistake.undo(camera.ego_from_camera))
    mounting, named = mounting_of(undone.ego_from_camera), direction_of_name(camera.name)
    level = abs(mounting.pitch_deg) <= LEVEL_DEG[0] and abs(mounting.roll_deg) <= LEVEL_DEG[1]
    fits_name = not by_name or named is None or turn_deg(named, mounting.yaw_deg) <= NAME_TURN_DEG
    return not _defects(undone) and level and fits_name


def _is_turned_about_one_axis(camera: Camera) -> bool:
    """Whether the camera is only tilted or only rolled: then the defect itself is the best description."""
    codes = [defect.code for defect in _defects(camera)]
    right, named = camera.ego_from_camera[:3, 0], direction_of_name(camera.name)
    if codes == ["camera-rolled"]:
        yaw_deg, level = mounting_of(camera.ego_from_camera).yaw_deg, True
    else:
        yaw_deg = float(np.degrees(np.arctan2(right[0], -right[1])))  # independent of pitch, even at 90 degrees
        level = abs(right[2]) <= np.sin(np.radians(LEVEL_DEG[1])) and codes in (["looks-at-ground"], ["looks-at-sky"])
    return bool(level and (named is None or turn_deg(named, yaw_deg) <= ONE_AXIS_TURN_DEG))


def _best_explanation(camera: Camera, explained: Mapping[str, Sequence[Mistake]]) -> Mistake | None:
    """The mistake that explains this camera and the most others; between equals the one that fits this camera best.

    None where it explains fewer than half of the affected cameras, which may be coincidence.
    """
    counts = {mistake: sum(mistake in of for of in explained.values()) for mistake in explained[camera.name]}
    best = max(counts, key=lambda mistake: (counts[mistake], -_misfit(mistake, camera)), default=None)
    return best if best is not None and 2 * counts[best] >= len(explained) else None


def _misfit(mistake: Mistake, camera: Camera) -> float:
    """Pitch, roll and angle to the named direction of the pose after undoing the mistake, summed, degrees."""
    mounting, named = mounting_of(mistake.undo(camera.ego_from_camera)), direction_of_name(camera.name)
    off_name = 0.0 if named is None else turn_deg(named, mounting.yaw_deg)
    return abs(mounting.pitch_deg) + abs(mounting.roll_deg) + off_name


def _mistake_finding(camera: Camera, mistake: Mistake, defect: Finding) -> Finding:
    undone = mounting_of(mistake.undo(camera.ego_from_camera))
    found = f"{defect.message}, {defect.found}"
    expected = f"level; corrected: height {undone.height:.2f} m, yaw {undone.yaw_deg:.0f}°, "
    expected += f"pitch {undone.pitch_deg:.0f}°"
    return Finding(mistake.code, "error", camera.name, mistake.message, found, expected, mistake.advice)


def _unit_finding(camera: Camera, unit: float) -> Finding:
    name = "millimetres" if unit == 1000 else "centimetres"
    translation = camera.ego_from_camera[:3, 3]
    return Finding(
        "translation-unit", "error", camera.name, f"the translation is in {name}",
        f"{np.linalg.norm(translation):.0f} m from the ego origin", f"metres, at most {MAX_DISTANCE_M:g}",
        f"divide it by {unit:g}",
    )  # fmt: skip
