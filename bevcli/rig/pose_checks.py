"""Camera poses that cannot be: the one mistake that explains a pose is found by undoing it.

A pose is implausible when the camera would be far from the vehicle, under the ground, look at the ground or the sky, or
be rolled. Then each usual mistake is undone in turn (units, inversion, quaternion order, axes); the one after which
the cameras stand as cameras do is reported, and not its consequences.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bevcli.findings import Finding
from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array, inverse, quaternion_from_rotation, rigid, rotation_from_quaternion
from bevcli.rig.names import direction_of_name, turn_deg
from bevcli.rig.pose import FRONT_OPTICAL, mounting_of, seen_fov_deg

FARTHEST_M = 15.0  # from the ego origin: a bus or a lorry's end
OTHER_UNIT_M = 30.0  # farther than this the translation is not in metres
LONGEST_CM = 790.0  # longer is in millimetres: 0.79 m from the ego origin is near, 7.9 m is far
HEIGHTS_M = (0.15, 5.0)  # bumper to the roof of a lorry
STEEPEST_DEG = 30.0  # pitched by more, and without the horizon in the image, a camera looks at ground or sky
MOST_ROLL_DEG = 30.0
LEVEL_DEG = (20.0, 10.0)  # pitch and roll of a pose that an explanation must arrive at
NAME_TURN_DEG = 80.0  # and at most so far from where the camera's name says that it looks
ONE_AXIS_TURN_DEG = 30.0  # a camera that is merely tilted still looks where its name says, by less than this


@dataclass(frozen=True)
class Mistake:
    """A usual mistake. undo: the pose as given (4, 4) -> the pose that was meant."""

    code: str
    message: str
    advice: str
    undo: Callable[[Array], Array]


def reordered(pose: Array, shift: int) -> Array:
    """The pose whose quaternion's four numbers are rolled by `shift` places: -1 reads w, x, y, z as x, y, z, w."""
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
        "camera-axes", "the pose is of axes x forward, y left, z up, not of the camera's own",
        "multiply by the rotation to x right, y down, z forward",
        lambda pose: rigid(pose[:3, 3], pose[:3, :3] @ FRONT_OPTICAL),
    ),
)  # fmt: skip


def check_poses(cameras: Sequence[Camera]) -> tuple[Finding, ...]:
    """Findings about single cameras' poses, all of severity error; none where every pose is plausible."""
    lengths = {camera.name: float(np.linalg.norm(camera.ego_from_camera[:3, 3])) for camera in cameras}
    unit = unit_of(max(lengths.values(), default=0.0))  # one rig is measured in one unit, if not all of it is wrong
    units = {name: unit if length > OTHER_UNIT_M else 1.0 for name, length in lengths.items()}
    findings = [_unit_finding(camera, units[camera.name]) for camera in cameras if units[camera.name] != 1]
    metric = [in_metres(camera, units[camera.name]) for camera in cameras]
    affected = [camera for camera in metric if defects_of(camera)]
    explained = {camera.name: [m for m in MISTAKES if _explains(m, camera)] for camera in affected}
    for camera in affected:
        defect, mistake = defects_of(camera)[0], _best(camera, explained)
        if mistake is None or (len(affected) == 1 and _is_turned_about_one_axis(camera)):
            findings.append(defect)
        else:
            findings.append(_mistake_finding(camera, mistake, defect))
    return tuple(findings)


def unit_of(length: float) -> float:
    """How many of the units of a translation of this length make a metre: 1, 100 or 1000."""
    if length <= OTHER_UNIT_M:
        return 1.0
    return 100.0 if length < LONGEST_CM else 1000.0


def in_metres(camera: Camera, unit: float) -> Camera:
    """The camera, its translation divided by `unit`."""
    pose = rigid(camera.ego_from_camera[:3, 3] / unit, camera.ego_from_camera[:3, :3])
    return replace(camera, ego_from_camera=pose)


def defects_of(camera: Camera) -> list[Finding]:
    """What is implausible about the pose itself, the gravest first."""
    mounting, name = mounting_of(camera.ego_from_camera), camera.name
    low, high = HEIGHTS_M
    defects = []
    if mounting.reach > FARTHEST_M:
        found = f"{mounting.reach:.1f} m from the ego origin"
        defects.append(_defect("camera-far", name, "is not on the vehicle", found, f"at most {FARTHEST_M:g} m"))
    if not low <= mounting.height <= high:
        found, expected = f"{mounting.height:.2f} m", f"{low:g} to {high:g} m above the ground"
        advice = "the ego origin is on the ground, under the rear axle"
        defects.append(_defect("camera-height", name, "is not at a camera's height", found, expected, advice))
    if abs(mounting.pitch_deg) > max(STEEPEST_DEG, seen_fov_deg(camera)[1] / 2):
        where = "ground" if mounting.pitch_deg < 0 else "sky"
        found, expected = f"pitch {mounting.pitch_deg:.0f}°", "the horizon in the image"
        defects.append(_defect(f"looks-at-{where}", name, f"looks at the {where}", found, expected))
    elif abs(mounting.roll_deg) > MOST_ROLL_DEG:
        message = "is upside down" if abs(mounting.roll_deg) > 150 else "is rolled about its viewing direction"
        found, advice = f"roll {mounting.roll_deg:.0f}°", "check the camera's pose; a quaternion has w first"
        defects.append(_defect("camera-rolled", name, message, found, f"within {MOST_ROLL_DEG:g}°", advice))
    return defects


def _defect(
    code: str, name: str, message: str, found: str, expected: str, advice: str = "check the camera's pose"
) -> Finding:
    return Finding(code, "error", name, message, found, expected, advice)


def _explains(mistake: Mistake, camera: Camera) -> bool:
    """Whether the camera stands as cameras do once the mistake is undone."""
    undone = replace(camera, ego_from_camera=mistake.undo(camera.ego_from_camera))
    mounting, said = mounting_of(undone.ego_from_camera), direction_of_name(camera.name)
    level = abs(mounting.pitch_deg) <= LEVEL_DEG[0] and abs(mounting.roll_deg) <= LEVEL_DEG[1]
    as_named = said is None or turn_deg(said, mounting.yaw_deg) <= NAME_TURN_DEG
    return not defects_of(undone) and level and as_named


def _is_turned_about_one_axis(camera: Camera) -> bool:
    """Whether the pose is that of a camera merely tilted or rolled in its place: a single camera's plain mistake."""
    codes = [defect.code for defect in defects_of(camera)]
    right, said = camera.ego_from_camera[:3, 0], direction_of_name(camera.name)
    if codes == ["camera-rolled"]:
        yaw_deg, level = mounting_of(camera.ego_from_camera).yaw_deg, True
    else:
        yaw_deg = float(np.degrees(np.arctan2(right[0], -right[1])))  # tilting leaves it, even straight up and down
        level = abs(right[2]) <= np.sin(np.radians(LEVEL_DEG[1])) and codes in (["looks-at-ground"], ["looks-at-sky"])
    return bool(level and (said is None or turn_deg(said, yaw_deg) <= ONE_AXIS_TURN_DEG))


def _best(camera: Camera, explained: Mapping[str, Sequence[Mistake]]) -> Mistake | None:
    """Of the mistakes that explain this camera the one that explains most cameras, and of equals the best fit.

    None where it explains fewer than half of the affected cameras: then it is chance.
    """
    counts = {mistake: sum(mistake in of for of in explained.values()) for mistake in explained[camera.name]}
    best = max(counts, key=lambda mistake: (counts[mistake], -_misfit(mistake, camera)), default=None)
    return best if best is not None and 2 * counts[best] >= len(explained) else None


def _misfit(mistake: Mistake, camera: Camera) -> float:
    """Degrees by which the undone pose is off level and off its name."""
    mounting, said = mounting_of(mistake.undo(camera.ego_from_camera)), direction_of_name(camera.name)
    off_name = 0.0 if said is None else turn_deg(said, mounting.yaw_deg)
    return abs(mounting.pitch_deg) + abs(mounting.roll_deg) + off_name


def _mistake_finding(camera: Camera, mistake: Mistake, defect: Finding) -> Finding:
    undone = mounting_of(mistake.undo(camera.ego_from_camera))
    found = f"{defect.message}, {defect.found}"
    expected = f"level; undone: height {undone.height:.2f} m, yaw {undone.yaw_deg:.0f}°, pitch {undone.pitch_deg:.0f}°"
    return Finding(mistake.code, "error", camera.name, mistake.message, found, expected, mistake.advice)


def _unit_finding(camera: Camera, unit: float) -> Finding:
    name = "millimetres" if unit == 1000 else "centimetres"
    translation = camera.ego_from_camera[:3, 3]
    return Finding(
        "translation-unit", "error", camera.name, f"the translation is in {name}",
        f"{np.linalg.norm(translation):.0f} m from the ego origin", f"metres, at most {FARTHEST_M:g}",
        f"divide it by {unit:g}",
    )  # fmt: skip
