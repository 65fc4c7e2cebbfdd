"""Pinhole images from which the image of a camera with lens distortion is resampled."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.geometry.cameras import OUTSIDE, Camera, fisheye_table
from bevcli.geometry.transforms import Array, rigid

WIDEST = 4.0  # tangent of the widest angle off the optical axis in one pinhole image; wider ones would be too large
SMALLEST_ANGLE = np.arctan(WIDEST)  # a lens model that ends inside the image, at a smaller angle, is a mistake
STEP = 16  # pixels between those whose rays are computed; a spline gives the others within 1e-4 pixels
# (5, 3, 3) camera_from_face: the faces of a cube around the camera, but that behind it.
FACES = np.array(
    [
        [[1, 0, 0], [0, 1, 0], [0, 0, 1]],  # ahead
        [[0, 0, -1], [0, 1, 0], [1, 0, 0]],  # left
        [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],  # right
        [[1, 0, 0], [0, 0, -1], [0, 1, 0]],  # above
        [[1, 0, 0], [0, 0, 1], [0, -1, 0]],  # below
    ],
    dtype=np.float64,
)


@dataclass(frozen=True)
class LensPart:
    """A pinhole image that gives a part of the image of a camera with distortion.

    Attributes:
        pinhole: the camera of the pinhole image.
        columns: (H, W) column in the pinhole image for each pixel of the camera's image; OUTSIDE for those that another
            part gives, or none.
        rows: as `columns`.
        needed: (H', W') 1 for the pixels of the pinhole image that are needed, 0 for the others.
    """

    pinhole: Camera
    columns: NDArray[np.float32]
    rows: NDArray[np.float32]
    needed: NDArray[np.uint8]


def lens_parts(camera: Camera) -> tuple[LensPart, ...]:
    """The pinhole images that give the image of a camera with distortion: a wider one, or up to five for a fisheye.

    They cost as much as rendering the image, so keep them for all frames.
    Raises InputError where a lens that is not "kannala_brandt" sees more than about 75 degrees off its optical axis,
    where the model of a fisheye ends within the image at a smaller angle, and where the whole image would be black.
    """
    from scipy.interpolate import RectBivariateSpline  # 0.2 s that other rigs do not need

    assert camera.distortion is not None
    u, v = np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64)
    some_u, some_v = (np.linspace(0, p[-1], max(len(p) // STEP, 4)) for p in (u, v))
    directions = _directions(camera, some_u, some_v)
    if (np.abs(directions[..., :2]) <= WIDEST * directions[..., 2:]).all():
        some = directions[..., :2] / directions[..., 2:]
        rays = [RectBivariateSpline(some_v, some_u, some[..., axis])(v, u) for axis in range(2)]
        return (_part(camera, FACES[0], rays),)
    if camera.distortion.model == "kannala_brandt":
        return _fisheye_parts(camera, _directions(camera, u, v))
    raise InputError(
        "its field of view is too wide to be rendered (expected at most 75 degrees off the optical axis, or a "
        '"kannala_brandt" lens): remove "distortion" from the rig or use a narrower lens'
    )


def _directions(camera: Camera, u: Array, v: Array) -> Array:
    """(V, U, 3) in the camera frame, of the pixels in columns (U,) and rows (V,)."""
    return camera.rays(np.stack(np.meshgrid(u, v), -1))


def _fisheye_parts(camera: Camera, directions: Array) -> tuple[LensPart, ...]:
    """directions: (H, W, 3) of the pixels in the camera frame; NaN where the image is black."""
    assert camera.distortion is not None
    end = fisheye_table(camera.distortion.coefficients)[0][-1]
    if end < SMALLEST_ANGLE and np.isnan(directions).any():
        raise InputError(
            f"its lens model ends {np.degrees(end):.0f} degrees off the optical axis, inside the image "
            '(expected at least 75): check "distortion" and "intrinsics"'
        )
    nearest = np.where(np.isfinite(directions).all(-1), (directions @ FACES[:, :, 2].T).argmax(-1), -1)
    parts = []
    for face, camera_from_face in enumerate(FACES):
        turned = directions @ camera_from_face
        with np.errstate(invalid="ignore", divide="ignore"):
            rays = np.where(nearest == face, np.moveaxis(turned[..., :2] / turned[..., 2:], -1, 0), np.nan)
        if (nearest == face).any():
            parts.append(_part(camera, camera_from_face, rays))
    if not parts:
        raise InputError('no pixel sees less than 120 degrees off the optical axis: check "intrinsics"')
    return tuple(parts)


def _part(camera: Camera, camera_from_part: Array, rays: Sequence[Array] | Array) -> LensPart:
    """camera_from_part: (3, 3). rays: x and y (H, W) in the part's frame at a depth of 1; NaN for pixels of others."""
    low, high = (np.array([limit(axis) for axis in rays]) for limit in (np.nanmin, np.nanmax))
    focal = np.array([camera.intrinsics[0, 0], camera.intrinsics[1, 1]])
    width, height = (int(np.ceil(n)) + 2 for n in (high - low) * focal)
    offset = -low * focal + 1
    intrinsics = np.array([[focal[0], 0, offset[0]], [0, focal[1], offset[1]], [0, 0, 1.0]])
    ego_from_part = camera.ego_from_camera @ rigid((0, 0, 0), camera_from_part)
    pinhole = replace(
        camera, width=width, height=height, intrinsics=intrinsics, ego_from_camera=ego_from_part, distortion=None
    )
    columns, rows = (
        np.nan_to_num((axis * scale + shift).astype(np.float32), copy=False, nan=OUTSIDE)
        for axis, scale, shift in zip(rays, focal, offset, strict=True)
    )
    given = columns >= 0
    used = np.zeros((height, width), np.uint8)
    used[rows[given].astype(np.int64), columns[given].astype(np.int64)] = 1
    needed = cv2.dilate(used, np.ones((2, 2), np.uint8), anchor=(1, 1))  # with the pixels at the right and below
    return LensPart(pinhole, columns, rows, needed.astype(np.uint8, copy=False))
