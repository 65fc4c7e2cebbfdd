"""Pinhole images from which the image of a camera with lens distortion is resampled."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.geometry.cameras import Camera, distort
from bevcli.geometry.transforms import Array, rigid

WIDEST = 4.0  # tangent of the widest angle off the optical axis in one pinhole image; wider ones would be too large
LARGEST_ANGLE = np.radians(120)  # off the optical axis; what a fisheye sees beyond is black
SMALLEST_ANGLE = np.arctan(WIDEST)  # a lens model that ends inside the image, at a smaller angle, is a mistake
ANGLES = 20_000  # of the table that inverts a fisheye's projection
REFINEMENTS = 15  # fixed-point steps; OpenCV's result alone is off by some pixels at strong distortion
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
        inside: (H, W) the pixels of the camera's image that this part gives.
        columns: (H, W) column in the pinhole image for each pixel of the camera's image; -1 for those not inside.
        rows: as `columns`.
    """

    pinhole: Camera
    inside: NDArray[np.bool_]
    columns: NDArray[np.float32]
    rows: NDArray[np.float32]


def lens_parts(camera: Camera) -> tuple[LensPart, ...]:
    """The pinhole images that give the image of a camera with distortion: a wider one, or up to five for a fisheye.

    Raises InputError where a lens that is not "kannala_brandt" sees more than about 75 degrees off its optical axis,
    where the model of a fisheye ends within the image at a smaller angle, and where the whole image would be black.
    """
    assert camera.distortion is not None
    u, v = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64))
    pixels = np.stack([u, v], -1)
    if camera.distortion.model == "kannala_brandt":
        directions = _fisheye_directions(camera, pixels)
        if not (np.abs(directions[..., :2]) <= WIDEST * directions[..., 2:]).all():
            return _fisheye_parts(camera, directions)
    rays = _undistorted_rays(camera, pixels.reshape(-1, 2)).reshape(pixels.shape)
    if not np.isfinite(rays).all() or np.abs(rays).max() > WIDEST:
        raise InputError(
            "its field of view is too wide to be rendered (expected at most 75 degrees off the optical axis, or a "
            '"kannala_brandt" lens): remove "distortion" from the rig or use a narrower lens'
        )
    return (_part(camera, FACES[0], rays, np.ones(u.shape, dtype=bool)),)


def _fisheye_parts(camera: Camera, directions: Array) -> tuple[LensPart, ...]:
    """directions: (H, W, 3) of the pixels in the camera frame; NaN where the image is black."""
    nearest = np.where(np.isfinite(directions).all(-1), (directions @ FACES[:, :, 2].T).argmax(-1), -1)
    parts = []
    for face, camera_from_face in enumerate(FACES):
        turned = directions @ camera_from_face
        with np.errstate(invalid="ignore", divide="ignore"):
            rays = turned[..., :2] / turned[..., 2:]
        if (nearest == face).any():
            parts.append(_part(camera, camera_from_face, rays, nearest == face))
    if not parts:
        raise InputError('no pixel sees less than 120 degrees off the optical axis: check "intrinsics"')
    return tuple(parts)


def _part(camera: Camera, camera_from_part: Array, rays: Array, inside: NDArray[np.bool_]) -> LensPart:
    """rays: (H, W, 2) normalised pinhole coordinates. camera_from_part: (3, 3)."""
    low, high = rays[inside].min(0), rays[inside].max(0)
    focal = np.array([camera.intrinsics[0, 0], camera.intrinsics[1, 1]])
    width, height = (int(np.ceil(n)) + 2 for n in (high - low) * focal)
    offset = -low * focal + 1
    intrinsics = np.array([[focal[0], 0, offset[0]], [0, focal[1], offset[1]], [0, 0, 1.0]])
    ego_from_part = camera.ego_from_camera @ rigid((0, 0, 0), camera_from_part)
    pinhole = replace(
        camera, width=width, height=height, intrinsics=intrinsics, ego_from_camera=ego_from_part, distortion=None
    )
    places = np.where(inside[..., None], rays * focal + offset, -1.0).astype(np.float32)
    return LensPart(pinhole, inside, np.ascontiguousarray(places[..., 0]), np.ascontiguousarray(places[..., 1]))


def _fisheye_directions(camera: Camera, pixels: Array) -> Array:
    """Directions (..., 3) of pixels (..., 2) in the camera frame; NaN beyond LARGEST_ANGLE and the lens model."""
    assert camera.distortion is not None
    bent = (pixels - camera.intrinsics[:2, 2]) @ np.linalg.inv(camera.intrinsics[:2, :2]).T
    radius = np.linalg.norm(bent, axis=-1)
    angles = np.linspace(0, LARGEST_ANGLE, ANGLES)
    radii = angles + sum(k * angles ** (2 * i + 3) for i, k in enumerate(camera.distortion.coefficients))
    falls = np.flatnonzero(np.diff(radii) <= 0)
    end = int(falls[0]) + 1 if len(falls) else ANGLES
    if radius.max() > radii[end - 1] and angles[end - 1] < SMALLEST_ANGLE:
        raise InputError(
            f"its lens model ends {np.degrees(angles[end - 1]):.0f} degrees off the optical axis, inside the image "
            '(expected at least 75): check "distortion" and "intrinsics"'
        )
    angle = np.interp(radius, radii[:end], angles[:end], right=np.nan)
    side = np.sin(angle) / np.where(radius > 0, radius, 1.0)
    return np.concatenate([bent * side[..., None], np.cos(angle)[..., None]], axis=-1)


def _undistorted_rays(camera: Camera, pixels: Array) -> Array:
    """(P, 2) normalised pinhole coordinates of pixels (P, 2), refined until distortion maps them to these pixels."""
    assert camera.distortion is not None
    coefficients = np.array(camera.distortion.coefficients)
    undistort = cv2.fisheye.undistortPoints if camera.distortion.model == "kannala_brandt" else cv2.undistortPoints
    rays = np.asarray(undistort(pixels[:, None], camera.intrinsics, coefficients), dtype=np.float64)[:, 0]
    wanted = (pixels - camera.intrinsics[:2, 2]) @ np.linalg.inv(camera.intrinsics[:2, :2]).T
    for _ in range(REFINEMENTS):
        rays = rays + (wanted - distort(rays, camera.distortion))
    return rays
