"""All checks of a rig: their order, which finding suppresses which, and the checks of lenses and of the bev frame.

Published weights expect nuScenes' LIDAR_TOP as bev frame: x right, y forward, 1.84 m above the ground.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from bevcli.findings import Finding, errors_of, rig_error
from bevcli.geometry.cameras import Camera, CameraRig
from bevcli.geometry.transforms import Array, inverse, rigid
from bevcli.rig.pose_checks import check_names, check_poses, corrected, reordered, seen_fov_deg, units_per_metre

BEV_ASSUMED = Finding(
    "bev-assumed", "info", None, 'the calibration has no "ego_from_bev"',
    advice="the default is used: a level frame at (0.94, 0, 1.84) m, x right, y forward",
)  # fmt: skip
MERGED_FROM = 3  # cameras with the same mistake: from this many on it is one finding on the whole rig


def rig_errors(rig: CameraRig) -> tuple[Finding, ...]:
    """The errors that `check_rig` finds, without the time that the coverage takes."""
    return errors_of(rig_findings(rig))


def rig_findings(rig: CameraRig, found_before: Sequence[Finding] = ()) -> list[Finding]:
    """All findings but those about coverage and the comparison with nuScenes. found_before: from reading the file.

    Consequences of a reported error are suppressed: a camera with an error from reading is not checked again, and names
    are compared only for cameras with plausible poses.
    """
    cameras = _without_errors(rig.cameras, found_before)
    poses, lenses = check_poses(cameras), check_lenses(cameras)
    names = check_names(_without_errors(cameras, poses)) + (_swapped_behind_mistake(cameras) if poses else ())
    rig_has_error = any(finding.camera is None for finding in errors_of(found_before))
    bev = () if rig_has_error else check_bev_frame(rig.ego_from_bev)
    assumed = [BEV_ASSUMED] if rig.ego_from_bev_assumed else []
    return [*found_before, *_merged(poses, cameras), *_merged(lenses, cameras), *names, *bev, *assumed]


def _swapped_behind_mistake(cameras: Sequence[Camera]) -> tuple[Finding, ...]:
    """Swapped names of cameras whose poses share another mistake, such as all inverted: seen once that is undone."""
    swapped = [finding for finding in check_names(corrected(cameras)) if finding.code == "swapped-names"]
    return tuple(replace(finding, advice=f"{finding.advice}, after correcting the poses") for finding in swapped)


def _without_errors(cameras: Sequence[Camera], findings: Iterable[Finding]) -> tuple[Camera, ...]:
    wrong = {finding.camera for finding in errors_of(findings)}
    return tuple(camera for camera in cameras if camera.name not in wrong)


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


CENTER_TOLERANCE = 0.15  # offset of the principal point from the image centre, relative to it; real cameras: 0.08
SAME_SCALE = 0.3  # largest relative difference of the two axes' scales for one other image size
MIN_FOV_DEG, MAX_PINHOLE_FOV_DEG = 10.0, 150.0
WIDE_PINHOLE_DEG = 120.0  # lenses this wide have distortion
SQUARE_PIXELS = 0.1
LARGEST_SKEW = 0.05  # relative to fx; real cameras: below 0.001
FARTHEST_CENTER = 0.25  # from the image, relative to its size: farther out not even cropped images have it
VALID_SHARE = 0.7  # a lens model must be valid up to this share of the distance to the image border
MAX_BEND = 2.0  # largest factor by which it may change the angle of a ray
_ANGLES = np.radians(np.arange(0.25, 89.5, 0.25))


def check_lenses(cameras: Sequence[Camera]) -> tuple[Finding, ...]:
    """At most one error a camera: of the lens model, image size, field of view or matrix; or else warnings."""
    findings: list[Finding] = []
    for camera in cameras:
        possible = (_distortion(camera), _resolution(camera), _field_of_view(camera), _center_or_skew(camera))
        error = next((finding for finding in possible if finding is not None), None)
        findings.extend([error] if error is not None else _lens_warnings(camera))
    return tuple(findings)


def _distortion(camera: Camera) -> Finding | None:
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
        ideal = focal * (_ANGLES if fisheye else np.tan(_ANGLES))
        valid = np.cumprod(np.isfinite(radii) & (radii > 0)).astype(bool)
        reach = float(np.max(radii[valid], initial=0.0))
        needed = VALID_SHARE * min(abs(edge), ideal[-1])
        if reach < needed:
            found = f"folds back {reach:.0f} px from the principal point"
            return _absurd(camera, found, f"valid over {abs(edge):.0f} px")
        bent = _ANGLES[valid][np.argmax(radii[valid] >= needed)]
        straight = float(np.interp(needed, ideal, _ANGLES))
        if not 1 / MAX_BEND <= bent / straight <= MAX_BEND:
            found = f"{np.degrees(bent):.0f}° where a lens without distortion has {np.degrees(straight):.0f}°"
            return _absurd(camera, found, f"within a factor of {MAX_BEND:g}")
    return None


def _radii(camera: Camera, axis: int, sign: float) -> Array:
    """Distance from the principal point along an axis, pixels, of rays at _ANGLES to the optical axis."""
    rays = np.zeros((len(_ANGLES), 3))
    rays[:, axis], rays[:, 2] = sign * np.sin(_ANGLES), np.cos(_ANGLES)
    return camera.project(rays)[0][:, axis] - camera.intrinsics[axis, 2]


def _absurd(camera: Camera, found: str, expected: str) -> Finding:
    advice = "check the model, and the order and sign of the coefficients"
    message = "the lens distortion is implausible inside the image"
    return Finding("distortion-absurd", "error", camera.name, message, found, expected, advice)


def _resolution(camera: Camera) -> Finding | None:
    """Intrinsics for images of another size: the principal point is at the centre of such an image."""
    doubled = 2 * camera.intrinsics[[0, 1], 2]
    size = np.array([camera.width, camera.height], dtype=np.float64)
    scale = doubled / size
    found = f"principal point {doubled[0] / 2:.0f}, {doubled[1] / 2:.0f} in {camera.width} x {camera.height}"
    expected = f"about {size[0] / 2:.0f}, {size[1] / 2:.0f}"
    if _near(doubled[0] / size[1]) and _near(doubled[1] / size[0]) and not _near(size[0] / size[1]):
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


def _field_of_view(camera: Camera) -> Finding | None:
    horizontal, vertical = seen_fov_deg(camera)
    fisheye = camera.distortion is not None and camera.distortion.model == "kannala_brandt"
    widest = 180.0 if fisheye else MAX_PINHOLE_FOV_DEG
    if min(horizontal, vertical) >= MIN_FOV_DEG / 2 and MIN_FOV_DEG <= horizontal <= widest:
        return None
    expected = f"{MIN_FOV_DEG:g}° to {widest:g}°"
    found = f"{horizontal:.1f}° horizontally, focal length {camera.intrinsics[0, 0]:.0f} px, image width {camera.width}"
    message, advice = "the field of view is implausible", "give the focal length in pixels of these images"
    return Finding("fov-implausible", "error", camera.name, message, found, expected, advice)


def _center_or_skew(camera: Camera) -> Finding | None:
    """A principal point far outside of the image, or a skew that no camera has."""
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


def _lens_warnings(camera: Camera) -> list[Finding]:
    warnings = []
    fx, fy = camera.intrinsics[0, 0], camera.intrinsics[1, 1]
    if abs(fx / fy - 1) > SQUARE_PIXELS:
        message, found = "the pixels are not square", f"fx / fy = {fx / fy:.2f}"
        advice = "correct only for images that were scaled along one axis"
        warnings.append(Finding("pixels-not-square", "warning", camera.name, message, found, "about 1", advice))
    center, size = camera.intrinsics[:2, 2], np.array([camera.width, camera.height])
    if (np.abs(2 * center / size - 1) > 2 * CENTER_TOLERANCE).any():
        found, expected = f"{center[0]:.0f}, {center[1]:.0f}", f"about {size[0] / 2:.0f}, {size[1] / 2:.0f}"
        message, advice = "the principal point is far from the image centre", "correct only for cropped images"
        warnings.append(Finding("principal-point", "warning", camera.name, message, found, expected, advice))
    if camera.distortion is None and seen_fov_deg(camera)[0] > WIDE_PINHOLE_DEG:
        found, message = f"{seen_fov_deg(camera)[0]:.0f}°", "the field of view is wide, but there is no lens distortion"
        advice = "add the lens model, or undistort the images"
        warnings.append(Finding("distortion-missing", "warning", camera.name, message, found, advice=advice))
    return warnings


def _near(ratio: float) -> bool:
    return abs(ratio - 1) <= CENTER_TOLERANCE


HEIGHT_M = 1.84  # of LIDAR_TOP in nuScenes
HEIGHT_ERROR_M, HEIGHT_WARNING_M = 1.2, 0.4
TILT_ERROR_DEG, TILT_WARNING_DEG = 15.0, 6.0
TILT_INFO_DEG = 1.0  # the demo model's training drives are level; nuScenes' LIDAR_TOP is tilted by 1 to 3
HEADING_DEG = 20.0
MAX_DISTANCE_M = 6.0


def check_bev_frame(ego_from_bev: Array) -> tuple[Finding, ...]:
    """Findings about ego_from_bev (4, 4): at most one error, or else warnings."""
    unit = units_per_metre(float(np.linalg.norm(ego_from_bev[:3, 3])))
    if unit != 1:
        found, expected = f"{np.linalg.norm(ego_from_bev[:3, 3]):.0f} m from the ego origin", "about (0.94, 0, 1.84) m"
        message = f'the translation of "ego_from_bev" is in {"millimetres" if unit == 1000 else "centimetres"}'
        return (rig_error("translation-unit", message, found, expected, f"divide the translation by {unit:g}"),)
    if _is_plausible(ego_from_bev):
        return _bev_warnings(ego_from_bev)
    return (_mistake(ego_from_bev) or _defect(ego_from_bev),)


def _tilt_deg(ego_from_bev: Array) -> float:
    """Angle between z of the bev frame and straight up, degrees."""
    return float(np.degrees(np.arccos(np.clip(ego_from_bev[2, 2], -1, 1))))


def _heading_deg(ego_from_bev: Array) -> float:
    """Angle of y of the bev frame, degrees counter-clockwise from the vehicle's forward direction; 0 is expected."""
    return float(np.degrees(np.arctan2(ego_from_bev[1, 1], ego_from_bev[0, 1])))


def _is_plausible(pose: Array) -> bool:
    height = abs(pose[2, 3] - HEIGHT_M) <= HEIGHT_ERROR_M
    level = _tilt_deg(pose) <= TILT_ERROR_DEG and abs(_heading_deg(pose)) <= HEADING_DEG
    return bool(height and level and np.hypot(pose[0, 3], pose[1, 3]) <= MAX_DISTANCE_M)


def _mistake(pose: Array) -> Finding | None:
    """The common mistake whose undoing gives a plausible frame."""
    # KITTI, Waymo and Argoverse have x forward: rotated to x right, such a frame is plausible.
    turned = rigid(pose[:3, 3], pose[:3, :3] @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    if _is_plausible(turned):
        message, advice = "has x forward", "rotate it by 90° about z, unless your weights were trained with x forward"
        found, expected = "x forward, y left", "x right, y forward"
        return rig_error("bev-x-forward", f'"ego_from_bev" {message}', found, expected, advice)
    if _is_plausible(inverse(pose)):
        code, message, advice = "transform-inverted", "is bev_from_ego, the inverse", "invert it"
    elif _is_plausible(reordered(pose, 1)) or _is_plausible(reordered(pose, -1)):
        code, advice = "quaternion-order", "put w first"
        message = "has a quaternion that is not in the order w, x, y, z"
    else:
        return None
    found = f"tilt {_tilt_deg(pose):.0f}°, y {_heading_deg(pose):.0f}° from forward, height {pose[2, 3]:.2f} m"
    return rig_error(code, f'"ego_from_bev" {message}', found, "x right, y forward, z up, z 1.84 m", advice)


def _defect(pose: Array) -> Finding:
    """The implausible property of the frame, where no common mistake explains it."""
    if _tilt_deg(pose) > TILT_ERROR_DEG:
        found, advice = f"{_tilt_deg(pose):.0f}°", "z of the bev frame points up"
        return rig_error("bev-tilted", '"ego_from_bev" is tilted', found, "level within 15°", advice)
    if abs(_heading_deg(pose)) > HEADING_DEG:
        message, found = 'y of "ego_from_bev" is not forward', f"y is {_heading_deg(pose):.0f}° to the left"
        return rig_error("bev-axes", message, found, "x right, y forward", "rotate it about z")
    if abs(pose[2, 3] - HEIGHT_M) > HEIGHT_ERROR_M:
        message, found = '"ego_from_bev" is not at the height that the weights expect', f"{pose[2, 3]:.2f} m"
        advice = "give its height above the ground; pillars extend from 4.5 m below this frame to 2.5 m above it"
        return rig_error("bev-height", message, found, f"about {HEIGHT_M} m", advice)
    found, expected = f"{np.hypot(pose[0, 3], pose[1, 3]):.1f} m from the ego origin", f"at most {MAX_DISTANCE_M:g} m"
    return rig_error("bev-far", '"ego_from_bev" is not on the vehicle', found, expected, "check its translation")


def _bev_warnings(pose: Array) -> tuple[Finding, ...]:
    findings = []
    if abs(pose[2, 3] - HEIGHT_M) > HEIGHT_WARNING_M:
        message, found = '"ego_from_bev" is higher or lower than nuScenes\'', f"{pose[2, 3]:.2f} m"
        advice = "place it 1.84 m above the ground"
        findings.append(Finding("bev-height", "warning", None, message, found, f"about {HEIGHT_M} m", advice))
    message, found = '"ego_from_bev" is tilted', f"{_tilt_deg(pose):.1f}°"
    if _tilt_deg(pose) > TILT_WARNING_DEG:
        findings.append(Finding("bev-tilted", "warning", None, message, found, "under 6°", "level it"))
    elif _tilt_deg(pose) > TILT_INFO_DEG:
        expected = "as in training: 1 to 3° in nuScenes, 0° in rendered drives"
        advice = "nothing for the demo model, which levels the frame itself"
        findings.append(Finding("bev-tilted", "info", None, message, found, expected, advice))
    return tuple(findings)
