"""Pinhole images from which the image of a camera with lens distortion is resampled."""

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.geometry.cameras import Camera, distort
from bevcli.geometry.transforms import Array

WIDEST = 4.0  # tangent of the widest angle off the optical axis; wider pinhole images would be too large
REFINEMENTS = 15  # fixed-point steps; OpenCV's result alone is off by some pixels at strong distortion


def distortion_maps(camera: Camera) -> tuple[Camera, NDArray[np.float32], NDArray[np.float32]]:
    """A wider pinhole camera, and column and row (H, W) in its image for each pixel of a camera with distortion.

    Raises InputError where the camera sees more than about 75 degrees off its optical axis.
    """
    u, v = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64))
    rays = _undistorted_rays(camera, np.stack([u, v], -1).reshape(-1, 2)).reshape(camera.height, camera.width, 2)
    if not np.isfinite(rays).all() or np.abs(rays).max() > WIDEST:
        raise InputError(
            "its field of view is too wide to be rendered (expected at most 75 degrees off the optical axis): "
            'remove "distortion" from the rig or use a narrower lens'
        )
    low, high = rays.reshape(-1, 2).min(0), rays.reshape(-1, 2).max(0)
    focal = np.array([camera.intrinsics[0, 0], camera.intrinsics[1, 1]])
    width, height = (int(np.ceil(n)) + 2 for n in (high - low) * focal)
    offset = -low * focal + 1
    intrinsics = np.array([[focal[0], 0, offset[0]], [0, focal[1], offset[1]], [0, 0, 1.0]])
    pinhole = replace(camera, width=width, height=height, intrinsics=intrinsics, distortion=None)
    pixels = (rays * focal + offset).astype(np.float32)
    return pinhole, np.ascontiguousarray(pixels[..., 0]), np.ascontiguousarray(pixels[..., 1])


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
