"""Frames of images that are in memory: they are checked against the rig, and mistakes of a caller are one line."""

from collections.abc import Mapping
from operator import index
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.frame import CameraImage, ColorOrder
from bevcli.geometry.cameras import Camera, CameraRig

EXAMPLE = 'such as {"CAM_FRONT": image}'


def checked_images(
    images: Mapping[str, NDArray[Any]], rig: CameraRig, color_order: ColorOrder, timestamp_ns: int
) -> dict[str, CameraImage]:
    """The images of a frame. Raises InputError where they are not images of cameras of the rig, by name."""
    if not isinstance(images, Mapping):
        count = f" of {len(images)}" if isinstance(images, list | tuple) else ""
        found = f"{type(images).__name__}{count}"
        raise InputError(f"`images`: expected a mapping of camera names to arrays, {EXAMPLE} (found {found})")
    check_cameras(images, rig, "images")
    for name, pixels in images.items():
        _check_image(pixels, rig[name])
    turned = images.items() if color_order == "bgr" else ((n, p[..., ::-1]) for n, p in images.items())
    return {name: CameraImage(timestamp_ns, np.ascontiguousarray(pixels)) for name, pixels in turned}


def check_cameras(by_camera: Mapping[str, object], rig: CameraRig, argument: str) -> None:
    """Raise InputError for a camera that the rig does not have."""
    for name in by_camera:
        if name not in rig.names:
            raise InputError(f"`{argument}`: camera {name} is not in the rig (it has {', '.join(rig.names)})")


def whole_nanoseconds(timestamp_ns: Any) -> int:
    """A time as an integer. Raises InputError for any other type, such as seconds as a float."""
    try:
        return index(timestamp_ns)
    except TypeError:
        found = f"{type(timestamp_ns).__name__} {timestamp_ns!r:.40}"
        advice = "pass round(seconds * 1e9)" if isinstance(timestamp_ns, float | np.floating) else "pass an int"
        raise InputError(f"`timestamp_ns`: expected whole nanoseconds (found {found}): {advice}") from None


def _check_image(pixels: NDArray[Any], camera: Camera) -> None:
    """Raise InputError where pixels are not an image of a camera."""
    shape, dtype = getattr(pixels, "shape", None), getattr(pixels, "dtype", type(pixels).__name__)
    if shape != (camera.height, camera.width, 3) or dtype != np.uint8:
        found = dtype if shape is None else f"{dtype} of shape {shape}"
        raise InputError(
            f"`images`: camera {camera.name}: expected uint8 of shape ({camera.height}, {camera.width}, 3), as in the "
            f"rig (found {found})"
        )
