"""Checks of camera poses, also against camera names: a name such as CAM_BACK_LEFT states a viewing direction.

A pose is implausible if the camera is far from the vehicle, under the ground, looks at the ground or the sky, or is
rolled. Then each common mistake is undone in turn (units, inversion, quaternion order, axes). If a plausible pose
results, the mistake is reported, not its consequences.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from bevcli.findings import Finding, rig_error
from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array, inverse, quaternion_from_rotation, rigid, rotation_from_quaternion

_STEP_DEG = 0.1
_ANGLES = np.radians(np.arange(-90 + _STEP_DEG / 2, 90, _STEP_DEG))


@dataclass(frozen=True)
class Mounting:
    """Position and angles of a camera in the ego frame."""

    position: Array  # (3,), metres
    yaw_deg: float  # viewing direction, counter-clockwise from straight ahead
    pitch_deg: float  # positive upwards
    roll_deg: float  # positive when the camera leans to its right; 180 is upside down

    @property
    def height(self) -> float:
        """Height above the ground plane of the ego frame, metres."""
        return float(self.position[2])


def mounting_of(ego_from_camera: Array) -> Mounting:
    """The mounting of a camera with this pose (4, 4)."""
    right, down, forward = ego_from_camera[:3, 0], ego_from_camera[:3, 1], ego_from_camera[:3, 2]
    return Mounting(
        position=ego_from_camera[:3, 3],
        yaw_deg=float(np.degrees(np.arctan2(forward[1], forward[0]))),
        pitch_deg=float(np.degrees(np.arcsin(np.clip(forward[2], -1, 1)))),
        roll_deg=float(np.degrees(np.arctan2(-right[2], -down[2]))),
    )


def degrees_text(angle_deg: float, digits: int = 1) -> str:
    """An angle as text, such as "0.4°"; zero has no sign."""
    return f"{round(angle_deg, digits) + 0.0:.{digits}f}°"


def seen_fov_deg(camera: Camera) -> tuple[float, float]:
    """Horizontal and vertical field of view through the optical axis, in degrees, lens distortion included.

    At most 180, because points behind the camera's plane are not projected.
    """
    (left, right), (up, down) = seen_range_deg(camera, 0), seen_range_deg(camera, 1)
    return right - left, down - up


def seen_range_deg(camera: Camera, axis: int) -> tuple[float, float]:
    """Smallest and largest angle to the optical axis that is inside the image, degrees.

    axis: 0 counts angles to the right, 1 downwards. (0, 0) where no ray is inside the image.
    """
    rays = np.zeros((len(_ANGLES), 3))
    rays[:, axis], rays[:, 2] = np.sin(_ANGLES), np.cos(_ANGLES)
    pixels, _ = camera.project(rays)
    size = (camera.width, camera.height)[axis]
    with np.errstate(invalid="ignore"):
        inside = (pixels[:, axis] > 0) & (pixels[:, axis] < size)
    seen = np.degrees(_ANGLES[inside])
    if len(seen) == 0:
        return 0.0, 0.0
    return float(seen[0]) - _STEP_DEG / 2, float(seen[-1]) + _STEP_DEG / 2


WORDS = {"front": "front", "forward": "front", "fwd": "front", "back": "back", "rear": "back", "backward": "back"}
# Centre of each sector, degrees counter-clockwise from straight ahead.
SECTORS = {
    ("front", ""): 0.0, ("front", "left"): 50.0, ("", "left"): 90.0, ("back", "left"): 130.0, ("back", ""): 180.0,
    ("back", "right"): -130.0, ("", "right"): -90.0, ("front", "right"): -50.0,
}  # fmt: skip
CONTRADICTION_DEG = 95.0  # a larger angle between name and pose is a contradiction
SWAP_GAIN_DEG = 60.0  # names are swapped if a permutation reduces the summed angle by at least this
EGO_TURN_DEG = (60.0, 35.0)  # all cameras turned by at least the first; their turns differ by at most the second
SAME_PLACE_M, SAME_DIRECTION_DEG = 0.02, 1.0
SAME_FOV = 0.2  # relative; one place may hold a wide and a tele camera, which differ by more
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


def direction_of_name(name: str) -> float | None:
    """Viewing direction that a name such as "CAM_BACK_LEFT" or "rearRight" states.

    Degrees counter-clockwise from straight ahead; None if the name states none, or a contradiction.
    """
    words = re.findall(r"[a-z]+", re.sub(r"([a-z])([A-Z])", r"\1 \2", name).lower())
    ends = {end for word, end in WORDS.items() if _contains(words, word)}
    sides = {side for side in ("left", "right") if _contains(words, side)}
    if len(ends) > 1 or len(sides) > 1:
        return None
    return SECTORS.get(("".join(ends), "".join(sides)))


def turn_deg(a: float, b: float) -> float:
    """The angle between two directions in degrees, 0 to 180."""
    return abs((a - b + 180.0) % 360.0 - 180.0)


def side_of(yaw_deg: float) -> str:
    """The side of the vehicle that a direction points to, such as "back left"."""
    words = min(SECTORS, key=lambda sector: turn_deg(SECTORS[sector], yaw_deg))
    return " ".join(filter(None, words)) if words != ("front", "") else "ahead"


def check_names(cameras: Sequence[Camera]) -> tuple[Finding, ...]:
    """Find copied poses, swapped names, and an ego frame whose x axis is not forward; at most one error per camera."""
    copies = _copied_poses(cameras)
    copied = {name for names, _ in copies for name in names}
    stated = {c.name: direction_of_name(c.name) for c in cameras if c.name not in copied}
    named = {name: direction for name, direction in stated.items() if direction is not None}
    yaws = {camera.name: mounting_of(camera.ego_from_camera).yaw_deg for camera in cameras}
    findings = tuple(finding for _, finding in copies)
    turned = _turned_ego_frame(named, yaws)
    return findings + ((turned,) if turned else _swapped_names(named, yaws))


def _contains(words: Sequence[str], word: str) -> bool:
    return any(part.startswith(word) or part.endswith(word) for part in words)


def _copied_poses(cameras: Sequence[Camera]) -> list[tuple[tuple[str, str], Finding]]:
    copies = []
    for a, b in combinations(cameras, 2):
        distance = float(np.linalg.norm(a.ego_from_camera[:3, 3] - b.ego_from_camera[:3, 3]))
        cosine = np.clip((np.trace(a.ego_from_camera[:3, :3].T @ b.ego_from_camera[:3, :3]) - 1) / 2, -1, 1)
        turn = float(np.degrees(np.arccos(cosine)))
        fov_a, fov_b = seen_fov_deg(a)[0], seen_fov_deg(b)[0]
        same_fov = abs(fov_a - fov_b) <= SAME_FOV * max(fov_a, fov_b)
        if distance < SAME_PLACE_M and turn < SAME_DIRECTION_DEG and same_fov:
            finding = Finding(
                "same-pose", "error", b.name, f"has the same pose as {a.name}",
                f"{distance:.3f} m and {turn:.2f}° apart", "different positions or viewing directions",
                "one pose is a copy of the other: give each camera its own",
            )  # fmt: skip
            copies.append(((a.name, b.name), finding))
    return copies


def _turned_ego_frame(named: Mapping[str, float], yaws: Mapping[str, float]) -> Finding | None:
    """All cameras turned by about the same angle from their names: x of the ego frame is not forward."""
    if len(named) < 3:
        return None
    turns = np.exp(1j * np.radians([yaws[name] - named[name] for name in named]))
    turn = float(np.degrees(np.angle(turns.mean())))
    spread = max(turn_deg(float(np.degrees(np.angle(turned))), turn) for turned in turns)
    if abs(turn) < EGO_TURN_DEG[0] or spread > EGO_TURN_DEG[1]:
        return None
    return rig_error(
        "ego-axes", "all cameras are turned by the same angle from the directions in their names",
        f"turned by {turn:.0f}°", "0° ± 35°", "the ego frame is x forward, y left, z up: rotate the poses into it",
    )  # fmt: skip


def _swapped_names(named: Mapping[str, float], yaws: Mapping[str, float]) -> tuple[Finding, ...]:
    """One finding if exchanging names makes them fit the poses; else one for each name that contradicts its pose."""
    names = list(named)
    if sum(turn_deg(named[name], yaws[name]) for name in names) < SWAP_GAIN_DEG:
        return ()  # without scipy.optimize, whose import takes 0.3 s of each run
    from scipy.optimize import linear_sum_assignment

    cost = np.array([[turn_deg(named[name], yaws[owner]) for owner in names] for name in names])
    rows, owners = linear_sum_assignment(cost)
    gain = float(np.trace(cost) - cost[rows, owners].sum())
    moved = [names[row] for row, owner in zip(rows, owners, strict=True) if row != owner]
    if moved and gain >= SWAP_GAIN_DEG:
        return (_swap_finding(moved, named, yaws),)
    contradicted = [name for name in names if turn_deg(named[name], yaws[name]) > CONTRADICTION_DEG]
    return tuple(
        Finding(
            "name-against-pose", "error", name, "the name and the pose state different directions",
            f"looks {_direction_text(yaws[name])}", _direction_text(named[name]),
            "check which camera this calibration belongs to",
        )
        for name in contradicted
    )  # fmt: skip


def _swap_finding(moved: Sequence[str], named: Mapping[str, float], yaws: Mapping[str, float]) -> Finding:
    names = f"{', '.join(moved[:-1])} and {moved[-1]}"
    return Finding(
        "swapped-names", "error", moved[0], f"the names or poses of {names} are swapped",
        "; ".join(f"{name} looks {_direction_text(yaws[name])}" for name in moved),
        "; ".join(_direction_text(named[name]) for name in moved),
        "exchange the poses, or the names",
    )  # fmt: skip


def _direction_text(yaw_deg: float) -> str:
    return f"{side_of(yaw_deg)} ({yaw_deg:.0f}°)"


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


def check_poses(cameras: Sequence[Camera]) -> tuple[Finding, ...]:
    """Errors about the poses of single cameras; none where every pose is plausible."""
    lengths = {camera.name: float(np.linalg.norm(camera.ego_from_camera[:3, 3])) for camera in cameras}
    unit = units_per_metre(max(lengths.values(), default=0.0))  # all wrong translations of a rig share one unit
    units = {name: unit if length > OTHER_UNIT_M else 1.0 for name, length in lengths.items()}
    findings = [_unit_finding(camera, units[camera.name]) for camera in cameras if units[camera.name] != 1]
    posed = ((camera, camera.ego_from_camera, units[camera.name]) for camera in cameras)
    metric = [replace(camera, ego_from_camera=rigid(pose[:3, 3] / unit, pose[:3, :3])) for camera, pose, unit in posed]
    affected, explained, common = _explanations(metric)
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
    affected, _, common = _explanations(cameras)
    if common is None:
        return ()
    kept = [camera for camera in affected if _explains(common, camera, by_name=False)]
    return tuple(replace(camera, ego_from_camera=common.undo(camera.ego_from_camera)) for camera in kept)


def _explanations(cameras: Sequence[Camera]) -> tuple[list[Camera], dict[str, list[Mistake]], Mistake | None]:
    """The affected cameras, by camera the mistakes that explain it, and the mistake in common.

    That one explains most affected cameras, at least three and more than half of them; None without one.
    """
    affected = [camera for camera in cameras if _defects(camera)]
    explained = {camera.name: [m for m in MISTAKES if _explains(m, camera)] for camera in affected}
    counts = {mistake: sum(mistake in of for of in explained.values()) for mistake in MISTAKES}
    best = max(MISTAKES, key=lambda mistake: counts[mistake])
    return affected, explained, best if counts[best] >= 3 and 2 * counts[best] > len(affected) else None


def units_per_metre(length: float) -> float:
    """1, 100 or 1000: whether a translation of this length is in metres, centimetres or millimetres."""
    if length <= OTHER_UNIT_M:
        return 1.0
    return 100.0 if length < MAX_CM else 1000.0


def _defects(camera: Camera) -> list[Finding]:
    mounting, name = mounting_of(camera.ego_from_camera), camera.name
    (low, high), away_m = HEIGHTS_M, np.hypot(*mounting.position[:2])
    defects = []
    if away_m > MAX_DISTANCE_M:
        found = f"{away_m:.1f} m from the ego origin"
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
    """True if undoing the mistake gives a plausible, level pose that fits the name, or with by_name=False any name."""
    undone = replace(camera, ego_from_camera=mistake.undo(camera.ego_from_camera))
    mounting, named = mounting_of(undone.ego_from_camera), direction_of_name(camera.name)
    level = abs(mounting.pitch_deg) <= LEVEL_DEG[0] and abs(mounting.roll_deg) <= LEVEL_DEG[1]
    fits_name = not by_name or named is None or turn_deg(named, mounting.yaw_deg) <= NAME_TURN_DEG
    return not _defects(undone) and level and fits_name


def _is_turned_about_one_axis(camera: Camera) -> bool:
    """True if the camera is only tilted or only rolled: then the defect itself is the best description."""
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
        f"divide the translation by {unit:g}",
    )  # fmt: skip
