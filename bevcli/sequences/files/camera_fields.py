"""One camera in calibration.json: its fields are checked and become a Camera."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bevcli.geometry.cameras import Camera, Distortion
from bevcli.geometry.transforms import Array
from bevcli.sequences.files.json_fields import Report, parse_numbers, shortened
from bevcli.sequences.files.transform_json import parse_transform

KEYS = ("width", "height", "intrinsics", "distortion", "ego_from_camera")
LARGEST_SIZE = 16384  # pixels of a side
FOCAL_RANGE = (0.05, 50.0)  # focal length divided by image size, from extreme fisheye to extreme telephoto
COEFFICIENT_COUNTS = {"brown_conrady": (4, 5, 8), "kannala_brandt": (4,)}


def parse_camera(name: str, value: object, report: Report) -> Camera | None:
    """The camera, or None if a field is invalid. All fields are read, so that all mistakes are reported."""
    if not is_camera_name(name):
        expected = "up to 100 letters, digits and signs, no slash"
        report.error("camera-name", shortened(name), "is not the name of a camera", expected=expected)
        return None
    if not isinstance(value, dict):
        report.error("wrong-shape", name, "is not a camera", expected="an object with " + ", ".join(KEYS), found=value)
        return None
    width, height = _parse_size(value, "width", report), _parse_size(value, "height", report)
    intrinsics = parse_intrinsics(value, report)
    ego_from_camera = parse_transform(value, "ego_from_camera", report)
    distortion = parse_distortion(value, report)
    if width is None or height is None or intrinsics is None or ego_from_camera is None:
        return None
    if not _are_plausible(intrinsics, width, height, report):
        return None
    return Camera(name, width, height, intrinsics, ego_from_camera, distortion)


def is_camera_name(name: str) -> bool:
    """Whether a camera may have this name: it becomes the name of a folder when images are written."""
    return 0 < len(name) <= 100 and name.isprintable() and not set(name) & {"/", "\\"} and name.strip(". ") != ""


def parse_intrinsics(camera: Mapping[str, Any], report: Report) -> Array | None:
    """(3, 3) image_from_camera in pixels, upper triangular and not singular; None if invalid."""
    matrix = parse_numbers(camera, "intrinsics", (3, 3), report)
    if matrix is None:
        return None
    if not np.allclose(matrix[2], [0, 0, 1], atol=1e-9) or abs(matrix[1, 0]) > 1e-9:
        expected = "[[fx, skew, cx], [0, fy, cy], [0, 0, 1]]"
        advice = "write it row by row and scale it so that the last number is 1"
        report.error(
            "intrinsics-form", "intrinsics", "is not a camera matrix",
            expected=expected, found=matrix.tolist(), advice=advice,
        )  # fmt: skip
        return None
    fx, fy = matrix[0, 0], matrix[1, 1]
    if min(fx, fy) <= 0:
        found = f"fx {fx:g}, fy {fy:g}"
        message = "is singular or mirrors the image"
        report.error("intrinsics-singular", "intrinsics", message, expected="fx > 0 and fy > 0", found=found)
        return None
    return matrix


def parse_distortion(camera: Mapping[str, Any], report: Report) -> Distortion | None:
    """The lens distortion. None for a pinhole camera ("none", or no "distortion") and for an invalid one."""
    value = camera.get("distortion")
    if value is None:
        return None
    models = ("none", *COEFFICIENT_COUNTS)
    model = value.get("model") if isinstance(value, dict) else None
    if model not in models:
        found = value if model is None else model
        report.error(
            "distortion-model", "distortion", "has an unknown model", expected=" or ".join(models), found=found
        )
        return None
    given = value.get("coefficients", [])
    count = len(given) if isinstance(given, list) else 0
    counts = COEFFICIENT_COUNTS.get(model, (0,))
    if count not in counts:
        expected, found = f"{' or '.join(map(str, counts))} for {model}", f"{count}"
        message = "has the wrong number of coefficients"
        report.error("distortion-coefficients", "distortion", message, expected=expected, found=found)
        return None
    if model == "none":
        return None
    coefficients = parse_numbers(value, "coefficients", (count,), report.within("distortion"))
    return None if coefficients is None else Distortion(model, tuple(map(float, coefficients)))


def _parse_size(camera: Mapping[str, Any], name: str, report: Report) -> int | None:
    value = camera.get(name)
    if value is None:
        report.missing(name, "the image size in pixels")
        return None
    if isinstance(value, bool) or not isinstance(value, int) or not 0 < value <= LARGEST_SIZE:
        expected = f"a positive integer, at most {LARGEST_SIZE}"
        report.error("wrong-size", name, "is not an image size", expected=expected, found=value)
        return None
    return value


def _are_plausible(intrinsics: Array, width: int, height: int, report: Report) -> bool:
    """Whether focal length and principal point are plausible in pixels of an image of this size."""
    low, high = FOCAL_RANGE
    for axis, (letter, size) in enumerate((("x", width), ("y", height))):
        focal, center = intrinsics[axis, axis], intrinsics[axis, 2]
        if not low * size <= focal <= high * size:
            expected, found = f"{low * size:g} to {high * size:g} px for a size of {size}", f"f{letter} {focal:g}"
            advice = "give it in pixels, not in millimetres"
            message = "has an implausible focal length"
            report.error("intrinsics-absurd", "intrinsics", message, expected=expected, found=found, advice=advice)
            return False
        if not -2 * size <= center <= 3 * size:
            expected, found = f"about {size / 2:g} px for a size of {size}", f"c{letter} {center:g}"
            message = "has its principal point far outside the image"
            report.error("intrinsics-absurd", "intrinsics", message, expected=expected, found=found)
            return False
    return True
