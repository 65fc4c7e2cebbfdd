"""The checks of a rig, one by one: mounting and names of the cameras, their lenses, and the bev frame.

A name such as CAM_BACK_LEFT states a viewing direction. Published weights expect nuScenes' LIDAR_TOP as bev frame: x
right, y forward, 1.84 m above the ground. `sequence_checks` runs the checks, and explains implausible poses.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from bevcli.errors import Finding
from bevcli.geometry.cameras import BEV_ORIGIN_M, Camera
from bevcli.geometry.transforms import Array

_STEP_DEG = 0.1
_ANGLES = np.radians(np.arange(-90 + _STEP_DEG / 2, 90, _STEP_DEG))


@dataclass(frozen=True)
class Mounting:
    """Position and angles of a camera in the ego frame."""

    x: float  # metres
    y: float  # metres
    height: float  # above the ground plane, metres
    yaw_deg: float  # viewing direction, counter-clockwise from straight ahead
    pitch_deg: float  # positive upwards
    roll_deg: float  # positive when the camera leans to its right; 180 is upside down


def mounting_of(ego_from_camera: Array) -> Mounting:
    """The mounting of a camera with this pose (4, 4)."""
    right, down, forward = ego_from_camera[:3, 0], ego_from_camera[:3, 1], ego_from_camera[:3, 2]
    x, y, height = ego_from_camera[:3, 3].tolist()
    return Mounting(
        x=x,
        y=y,
        height=height,
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
MAX_CAMERA_DISTANCE_M = 15.0  # from the ego origin; the rear end of a bus or a lorry
CAMERA_HEIGHTS_M = (0.15, 5.0)  # from a bumper to the roof of a lorry
MAX_PITCH_DEG = 30.0  # beyond it, and without the horizon in the image, a camera looks at the ground or the sky
MAX_ROLL_DEG = 30.0


def direction_of_name(name: str) -> float | None:
    """Viewing direction that a name such as "CAM_BACK_LEFT" or "rearRight" states.

    Degrees counter-clockwise from straight ahead; None if the name states none, or a contradiction.
    """
    words = re.findall(r"[a-z]+", re.sub(r"([a-z])([A-Z])", r"\1 \2", name).lower())
    ends = {
        end
        for word_part, end in WORDS.items()
        for word in words
        if word.startswith(word_part) or word.endswith(word_part)
    }
    sides = {side for side in ("left", "right") for word in words if word.startswith(side) or word.endswith(side)}
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
    findings, copied = list[Finding](), set[str]()
    for a, b in combinations(cameras, 2):
        distance = float(np.linalg.norm(a.ego_from_camera[:3, 3] - b.ego_from_camera[:3, 3]))
        cosine = np.clip((np.trace(a.ego_from_camera[:3, :3].T @ b.ego_from_camera[:3, :3]) - 1) / 2, -1, 1)
        turn = float(np.degrees(np.arccos(cosine)))
        fov_a, fov_b = seen_fov_deg(a)[0], seen_fov_deg(b)[0]
        same_fov = abs(fov_a - fov_b) <= SAME_FOV * max(fov_a, fov_b)
        if distance < SAME_PLACE_M and turn < SAME_DIRECTION_DEG and same_fov:
            copied |= {a.name, b.name}
            findings.append(Finding(
                "same-pose", "error", b.name, f"has the same pose as {a.name}",
                f"{distance:.3f} m and {turn:.2f}° apart", "different positions or viewing directions",
                "one pose is a copy of the other: give each camera its own",
            ))  # fmt: skip
    yaws = {camera.name: mounting_of(camera.ego_from_camera).yaw_deg for camera in cameras}
    directions = {name: direction_of_name(name) for name in yaws if name not in copied}
    named = {name: direction for name, direction in directions.items() if direction is not None}
    if sum(turn_deg(direction, yaws[name]) for name, direction in named.items()) < SWAP_GAIN_DEG:
        return tuple(findings)
    turned = _turned_ego_frame(named, yaws)
    return (*findings, *((turned,) if turned else _swapped_names(named, yaws)))


def _turned_ego_frame(named: Mapping[str, float], yaws: Mapping[str, float]) -> Finding | None:
    """All cameras turned by about the same angle from their names: x of the ego frame is not forward."""
    if len(named) < 3:
        return None
    turns = np.exp(1j * np.radians([yaws[name] - named[name] for name in named]))
    turn = float(np.degrees(np.angle(turns.mean())))
    spread = max(turn_deg(float(np.degrees(np.angle(turned))), turn) for turned in turns)
    if abs(turn) < EGO_TURN_DEG[0] or spread > EGO_TURN_DEG[1]:
        return None
    return Finding(
        "ego-axes", "error", None, "all cameras are turned by the same angle from the directions in their names",
        f"turned by {turn:.0f}°", "0° ± 35°", "the ego frame is x forward, y left, z up: rotate the poses into it",
    )  # fmt: skip


def _swapped_names(named: Mapping[str, float], yaws: Mapping[str, float]) -> tuple[Finding, ...]:
    """One finding if exchanging names makes them fit the poses; else one for each name that contradicts its pose."""
    from scipy.optimize import linear_sum_assignment  # its import takes 0.3 s, which most runs save

    names = list(named)
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


def pose_defects(camera: Camera) -> list[Finding]:
    """The implausible properties of a pose, as errors; the first is the most telling."""
    mounting, advice = mounting_of(camera.ego_from_camera), "check the camera's pose"
    (low, high), away_m = CAMERA_HEIGHTS_M, np.hypot(mounting.x, mounting.y)
    defects = list[tuple[str, str, str, str, str]]()
    if away_m > MAX_CAMERA_DISTANCE_M:
        found, expected = f"{away_m:.1f} m from the ego origin", f"at most {MAX_CAMERA_DISTANCE_M:g} m"
        defects.append(("camera-far", "is not on the vehicle", found, expected, advice))
    if not low <= mounting.height <= high:
        found, expected = f"{mounting.height:.2f} m", f"{low:g} to {high:g} m above the ground"
        origin = "the ego origin is on the ground, under the rear axle"
        defects.append(("camera-height", "has an implausible height", found, expected, origin))
    if abs(mounting.pitch_deg) > max(MAX_PITCH_DEG, seen_fov_deg(camera)[1] / 2):
        target = "ground" if mounting.pitch_deg < 0 else "sky"
        found, expected = f"pitch {mounting.pitch_deg:.0f}°", "the horizon in the image"
        defects.append((f"looks-at-{target}", f"looks at the {target}", found, expected, advice))
    elif abs(mounting.roll_deg) > MAX_ROLL_DEG:
        message = "is upside down" if abs(mounting.roll_deg) > 150 else "is rolled about its viewing direction"
        found, order = f"roll {mounting.roll_deg:.0f}°", "check the camera's pose; a quaternion has w first"
        defects.append(("camera-rolled", message, found, f"within {MAX_ROLL_DEG:g}°", order))
    return [Finding(code, "error", camera.name, *texts) for code, *texts in defects]


CENTER_TOLERANCE = 0.15  # offset of the principal point from the image centre, relative to it; real cameras: 0.08
SAME_SCALE = 0.3  # largest relative difference of the two axes' scales for one other image size
MIN_FOV_DEG, MAX_PINHOLE_FOV_DEG = 10.0, 150.0
WIDE_PINHOLE_DEG = 120.0  # lenses this wide have distortion
SQUARE_PIXELS = 0.1
LARGEST_SKEW = 0.05  # relative to fx; real cameras: below 0.001
FARTHEST_CENTER = 0.25  # from the image, relative to its size: farther out not even cropped images have it
VALID_SHARE = 0.7  # a lens model must be valid up to this share of the distance to the image border
MAX_BEND = 2.0  # largest factor by which it may change the angle of a ray
_LENS_ANGLES = np.radians(np.arange(0.25, 89.5, 0.25))


def check_lenses(cameras: Sequence[Camera]) -> list[Finding]:
    """At most one error a camera: of the lens model, image size, field of view or matrix; or else warnings."""
    findings: list[Finding] = []
    for camera in cameras:
        error = _distortion_error(camera) or _size_error(camera) or _matrix_error(camera)
        if error is not None:
            findings.append(error)
            continue
        fx, fy = camera.intrinsics[0, 0], camera.intrinsics[1, 1]
        if abs(fx / fy - 1) > SQUARE_PIXELS:
            message, found = "the pixels are not square", f"fx / fy = {fx / fy:.2f}"
            advice = "correct only for images that were scaled along one axis"
            findings.append(Finding("pixels-not-square", "warning", camera.name, message, found, "about 1", advice))
        center, size = camera.intrinsics[:2, 2], np.array([camera.width, camera.height])
        if (np.abs(2 * center / size - 1) > 2 * CENTER_TOLERANCE).any():
            found, expected = f"{center[0]:.0f}, {center[1]:.0f}", f"about {size[0] / 2:.0f}, {size[1] / 2:.0f}"
            message, advice = "the principal point is far from the image centre", "correct only for cropped images"
            findings.append(Finding("principal-point", "warning", camera.name, message, found, expected, advice))
        if camera.distortion is None and seen_fov_deg(camera)[0] > WIDE_PINHOLE_DEG:
            found = f"{seen_fov_deg(camera)[0]:.0f}°"
            message = "the field of view is wide, but there is no lens distortion"
            advice = "add the lens model, or undistort the images"
            findings.append(Finding("distortion-missing", "warning", camera.name, message, found, advice=advice))
    return findings


def _distortion_error(camera: Camera) -> Finding | None:
    """A lens model that folds back inside the image, or that changes angles by too much."""
    if camera.distortion is None:
        return None
    edges = np.array([camera.width, camera.height, 0, 0]) - np.tile(camera.intrinsics[:2, 2], 2)
    focals = np.tile(camera.intrinsics[[0, 1], [0, 1]], 2)
    fisheye = camera.distortion.model == "kannala_brandt"
    for direction, edge, focal in zip((0, 1, 0, 1), edges, focals, strict=True):
        if abs(edge) < 1:
            continue
        radii = np.sign(edge) * _radii(camera, direction, float(np.sign(edge)))
        ideal = focal * (_LENS_ANGLES if fisheye else np.tan(_LENS_ANGLES))
        valid = np.cumprod(np.isfinite(radii) & (radii > 0)).astype(bool)
        reach = float(np.max(radii[valid], initial=0.0))
        needed = VALID_SHARE * min(abs(edge), ideal[-1])
        if reach < needed:
            found = f"folds back {reach:.0f} px from the principal point"
            return _absurd(camera, found, f"valid over {abs(edge):.0f} px")
        bent = _LENS_ANGLES[valid][np.argmax(radii[valid] >= needed)]
        straight = float(np.interp(needed, ideal, _LENS_ANGLES))
        if not 1 / MAX_BEND <= bent / straight <= MAX_BEND:
            found = f"{np.degrees(bent):.0f}° where a lens without distortion has {np.degrees(straight):.0f}°"
            return _absurd(camera, found, f"within a factor of {MAX_BEND:g}")
    return None


def _radii(camera: Camera, axis: int, sign: float) -> Array:
    """Distance from the principal point along an axis, pixels, of rays at _LENS_ANGLES to the optical axis."""
    rays = np.zeros((len(_LENS_ANGLES), 3))
    rays[:, axis], rays[:, 2] = sign * np.sin(_LENS_ANGLES), np.cos(_LENS_ANGLES)
    return camera.project(rays)[0][:, axis] - camera.intrinsics[axis, 2]


def _absurd(camera: Camera, found: str, expected: str) -> Finding:
    advice = "check the model, and the order and sign of the coefficients"
    message = "the lens distortion is implausible inside the image"
    return Finding("distortion-absurd", "error", camera.name, message, found, expected, advice)


def _size_error(camera: Camera) -> Finding | None:
    """Intrinsics for images of another size: the principal point is at the centre of such an image."""
    doubled = 2 * camera.intrinsics[[0, 1], 2]
    size = np.array([camera.width, camera.height], dtype=np.float64)
    scale = doubled / size
    found = f"principal point {doubled[0] / 2:.0f}, {doubled[1] / 2:.0f} in {camera.width} x {camera.height}"
    expected = f"about {size[0] / 2:.0f}, {size[1] / 2:.0f}"
    crossed = np.abs(doubled / size[::-1] - 1) <= CENTER_TOLERANCE
    if crossed.all() and abs(size[0] / size[1] - 1) > CENTER_TOLERANCE:
        message, advice = "width and height, or the axes of the intrinsics, are swapped", "exchange them"
        return Finding("intrinsics-resolution", "error", camera.name, message, found, expected, advice)
    off = np.abs(scale - 1) > CENTER_TOLERANCE
    alike = scale.min() > 0 and scale.max() / scale.min() < 1 + SAME_SCALE
    if not (off.all() and (scale > 1).all() == (scale > 1).any() and alike):
        return None
    factor = 1 / float(scale.mean())
    focal = f", focal length {camera.intrinsics[0, 0] / camera.width:.2f} of the width"
    advice = f"multiply fx, fy, cx, cy by about {factor:.2f}, or give the image size for which they were calibrated"
    message = f"the intrinsics belong to images of about {doubled[0]:.0f} x {doubled[1]:.0f} pixels"
    return Finding("intrinsics-resolution", "error", camera.name, message, found + focal, expected, advice)


def _matrix_error(camera: Camera) -> Finding | None:
    """A field of view or a skew that no camera has, or a principal point far outside of the image."""
    horizontal, vertical = seen_fov_deg(camera)
    fisheye = camera.distortion is not None and camera.distortion.model == "kannala_brandt"
    widest = 180.0 if fisheye else MAX_PINHOLE_FOV_DEG
    if min(horizontal, vertical) < MIN_FOV_DEG / 2 or not MIN_FOV_DEG <= horizontal <= widest:
        found = f"{horizontal:.1f}° horizontally, focal length {camera.intrinsics[0, 0]:.0f} px, "
        found += f"image width {camera.width}"
        message, advice = "the field of view is implausible", "give the focal length in pixels of these images"
        expected = f"{MIN_FOV_DEG:g}° to {widest:g}°"
        return Finding("fov-implausible", "error", camera.name, message, found, expected, advice)
    advice = "write the matrix row by row, [[fx, skew, cx], [0, fy, cy], [0, 0, 1]], in pixels of these images"
    skew, center = float(camera.intrinsics[0, 1]), camera.intrinsics[:2, 2]
    if abs(skew) > LARGEST_SKEW * camera.intrinsics[0, 0]:
        message = "the intrinsics have a skew that no camera has"
        return Finding("intrinsics-skew", "error", camera.name, message, f"{skew:g} px", "about 0", advice)
    if (abs(center / (camera.width, camera.height) - 0.5) <= 0.5 + FARTHEST_CENTER).all():
        return None
    message, found = "the principal point is far outside of the image", f"{center[0]:.0f}, {center[1]:.0f}"
    expected = f"about {camera.width / 2:.0f}, {camera.height / 2:.0f}"
    return Finding("principal-point", "error", camera.name, message, found, expected, advice)


BEV_HEIGHT_M = BEV_ORIGIN_M[2]
HEIGHT_ERROR_M, HEIGHT_WARNING_M = 1.2, 0.4
TILT_ERROR_DEG, TILT_WARNING_DEG = 15.0, 6.0
TILT_INFO_DEG = 1.0  # the demo model's training drives are level; nuScenes' LIDAR_TOP is tilted by 1 to 3
HEADING_DEG = 20.0
MAX_BEV_DISTANCE_M = 6.0


def bev_angles_deg(ego_from_bev: Array) -> tuple[float, float]:
    """Tilt and heading of the bev frame: of its z from straight up, and of its y to the left of forward, degrees."""
    tilt = np.arccos(np.clip(ego_from_bev[2, 2], -1, 1))
    return float(np.degrees(tilt)), float(np.degrees(np.arctan2(ego_from_bev[1, 1], ego_from_bev[0, 1])))


def is_plausible_bev_frame(ego_from_bev: Array) -> bool:
    """True if the bev frame is on the vehicle, at about nuScenes' height, level, and has y forward."""
    (tilt, heading), (x, y, height) = bev_angles_deg(ego_from_bev), ego_from_bev[:3, 3]
    turned = tilt > TILT_ERROR_DEG or abs(heading) > HEADING_DEG
    return not turned and bool(abs(height - BEV_HEIGHT_M) <= HEIGHT_ERROR_M and np.hypot(x, y) <= MAX_BEV_DISTANCE_M)


def bev_warnings(ego_from_bev: Array) -> list[Finding]:
    """What is unusual about a plausible bev frame."""
    findings, height, tilt = [], ego_from_bev[2, 3], bev_angles_deg(ego_from_bev)[0]
    if abs(height - BEV_HEIGHT_M) > HEIGHT_WARNING_M:
        message, found = '"ego_from_bev" is higher or lower than nuScenes\'', f"{height:.2f} m"
        advice = f"place it {BEV_HEIGHT_M} m above the ground"
        findings.append(Finding("bev-height", "warning", None, message, found, f"about {BEV_HEIGHT_M} m", advice))
    message, found = '"ego_from_bev" is tilted', f"{tilt:.1f}°"
    if tilt > TILT_WARNING_DEG:
        findings.append(Finding("bev-tilted", "warning", None, message, found, "under 6°", "level it"))
    elif tilt > TILT_INFO_DEG:
        expected = "as in training: 1 to 3° in nuScenes, 0° in rendered drives"
        advice = "nothing for the demo model, which levels the frame itself"
        findings.append(Finding("bev-tilted", "info", None, message, found, expected, advice))
    return findings
