"""Checks of intrinsics and lens distortion: implausible values, and values for images of another size."""

from collections.abc import Sequence

import numpy as np

from bevcli.findings import Finding
from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array
from bevcli.rig.mounting import seen_fov_deg

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
    """At most one error a camera: from the lens model, the image size, the field of view, or the matrix, in this order.

    Cameras without an error may get warnings.
    """
    findings: list[Finding] = []
    for camera in cameras:
        possible = (_distortion(camera), _resolution(camera), _field_of_view(camera), _center_or_skew(camera))
        error = next((finding for finding in possible if finding is not None), None)
        findings.extend([error] if error is not None else _warnings(camera))
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


def _warnings(camera: Camera) -> list[Finding]:
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
