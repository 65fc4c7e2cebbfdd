"""Camera and CameraRig. The one projection of the project: encoder, overlays, rig checks and renderer use it.

Camera frame: x right, y down, z forward. Pixels: the centre of the top left pixel is (0, 0), as in OpenCV.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from bevcli.geometry.transforms import Array, apply, inverse, rigid

NEAR_M = 1e-5  # points nearer than this to the camera's plane, or behind it, have no image


@dataclass(frozen=True)
class Distortion:
    """A lens: Brown-Conrady (k1 k2 p1 p2 [k3 [k4 k5 k6]]) or Kannala-Brandt fisheye (k1 k2 k3 k4), as OpenCV's."""

    model: Literal["brown_conrady", "kannala_brandt"]
    coefficients: tuple[float, ...]


@dataclass(frozen=True)
class Camera:
    """One pinhole camera, maybe behind a lens with distortion.

    width, height: pixels. intrinsics: (3, 3) image_from_camera. ego_from_camera: (4, 4), metres.
    """

    name: str
    width: int
    height: int
    intrinsics: Array
    ego_from_camera: Array
    distortion: Distortion | None = None

    @property
    def camera_from_ego(self) -> Array:
        """(4, 4)."""
        return inverse(self.ego_from_camera)

    @property
    def image_from_camera(self) -> Array:
        """(4, 4) homogeneous: (u d, v d, d, 1) = image_from_camera @ (x, y, z, 1), without distortion."""
        return rigid((0, 0, 0), self.intrinsics)

    @property
    def yaw(self) -> float:
        """Viewing direction in the ego frame, radians counter-clockwise from straight ahead."""
        return float(np.arctan2(self.ego_from_camera[1, 2], self.ego_from_camera[0, 2]))

    @property
    def fov_deg(self) -> tuple[float, float]:
        """Horizontal and vertical field of view in degrees of the pinhole, without distortion."""
        fx, fy = self.intrinsics[0, 0], self.intrinsics[1, 1]
        return (
            float(np.degrees(2 * np.arctan(self.width / (2 * fx)))),
            float(np.degrees(2 * np.arctan(self.height / (2 * fy)))),
        )

    def project(self, points_camera: ArrayLike) -> tuple[Array, Array]:
        """Points (..., 3) in the camera frame -> pixels (..., 2) and depths (...,).

        Distortion included. Pixels of points with depth <= NEAR_M are NaN.
        """
        points = np.asarray(points_camera, dtype=np.float64)
        depth = points[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            rays = points[..., :2] / np.where(depth > NEAR_M, depth, np.nan)[..., None]
        if self.distortion is not None:
            rays = distort(rays, self.distortion)
        pixels = rays @ self.intrinsics[:2, :2].T + self.intrinsics[:2, 2]
        return pixels, depth

    def project_ego(self, points_ego: ArrayLike) -> tuple[Array, Array]:
        """Points (..., 3) in the ego frame at the camera's time -> pixels (..., 2) and depths (...,)."""
        return self.project(apply(self.camera_from_ego, points_ego))

    def contains(self, pixels: ArrayLike, depth: ArrayLike) -> NDArray[np.bool_]:
        """Which pixels (..., 2) at these depths (...,) lie in front of the camera and inside the image."""
        p = np.asarray(pixels, dtype=np.float64)
        with np.errstate(invalid="ignore"):
            inside = (p > 0).all(-1) & (p[..., 0] < self.width) & (p[..., 1] < self.height)
        return inside & (np.asarray(depth) > NEAR_M)

    def scaled(self, factor_x: float, factor_y: float | None = None) -> Camera:
        """The camera whose image is this one's, resized. Pixels times the factor, without a half-pixel term."""
        factors = np.diag([factor_x, factor_x if factor_y is None else factor_y, 1.0])
        width, height = round(self.width * factors[0, 0]), round(self.height * factors[1, 1])
        return replace(self, width=width, height=height, intrinsics=factors @ self.intrinsics)

    def cropped(self, left: int, top: int, width: int, height: int) -> Camera:
        """The camera of a part of the image; a part that reaches beyond the image is padding."""
        shift = np.array([[1.0, 0, -left], [0, 1.0, -top], [0, 0, 1.0]])
        return replace(self, width=width, height=height, intrinsics=shift @ self.intrinsics)

    def undistorted(self) -> Camera:
        """The pinhole camera with the same intrinsics that `undistort_maps` resamples to."""
        return replace(self, distortion=None)

    def undistort_maps(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Maps (H, W) x and y for cv2.remap: from each pixel of `undistorted()` to this camera's image."""
        u, v = np.meshgrid(np.arange(self.width, dtype=np.float64), np.arange(self.height, dtype=np.float64))
        pixels = np.stack([u, v, np.ones_like(u)], axis=-1)
        rays = pixels @ np.linalg.inv(self.intrinsics).T
        source, _ = self.project(rays)
        return source[..., 0].astype(np.float32), source[..., 1].astype(np.float32)


@dataclass(frozen=True)
class CameraRig:
    """The cameras on the vehicle, and the frame that the model predicts in.

    ego_from_bev: (4, 4). ego_from_bev_assumed: the calibration did not state it and the default was taken.
    """

    cameras: tuple[Camera, ...]
    ego_from_bev: Array
    ego_from_bev_assumed: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        """The cameras' names, in the rig's order."""
        return tuple(camera.name for camera in self.cameras)

    def __getitem__(self, name: str) -> Camera:
        return next(camera for camera in self.cameras if camera.name == name)


def default_ego_from_bev() -> Array:
    """(4, 4) of a level frame like nuScenes' LIDAR_TOP: x right, y forward, at (0.94, 0, 1.84) m in ego."""
    return rigid((0.94, 0.0, 1.84), [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def distort(rays: ArrayLike, distortion: Distortion) -> Array:
    """Normalised pinhole coordinates (..., 2) -> where the lens puts them (..., 2); NaN stays NaN.

    Beyond the angle where the lens model folds back on itself the result is NaN.
    """
    xy = np.asarray(rays, dtype=np.float64)
    if distortion.model == "kannala_brandt":
        return _distort_kannala_brandt(xy, distortion.coefficients)
    return _distort_brown_conrady(xy, distortion.coefficients)


def _distort_kannala_brandt(xy: Array, coefficients: tuple[float, ...]) -> Array:
    radius = np.linalg.norm(xy, axis=-1)
    theta = np.arctan(radius)
    powers = np.stack([theta ** (2 * i + 2) for i in range(len(coefficients))], axis=-1)
    distorted = theta * (1 + powers @ np.asarray(coefficients))
    slope = 1 + powers @ (np.asarray(coefficients) * (2 * np.arange(len(coefficients)) + 3))
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.where(radius > 1e-12, distorted / radius, 1.0)
        return xy * np.where(slope > 0, ratio, np.nan)[..., None]


def _distort_brown_conrady(xy: Array, coefficients: tuple[float, ...]) -> Array:
    k1, k2, p1, p2, k3, k4, k5, k6 = (*coefficients, *([0.0] * (8 - len(coefficients))))
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    above, below = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    above_slope, below_slope = k1 + r2 * (2 * k2 + 3 * r2 * k3), k4 + r2 * (2 * k5 + 3 * r2 * k6)
    radial = above / below
    slope = radial + 2 * r2 * (above_slope * below - above * below_slope) / below**2
    result = np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=-1,
    )
    with np.errstate(invalid="ignore"):
        return np.where((slope > 0)[..., None], result, np.nan)


def undistort(image: NDArray[np.uint8], camera: Camera) -> NDArray[np.uint8]:
    """The image (H, W, 3) that `camera.undistorted()` would have taken; black where the lens saw nothing."""
    map_x, map_y = (np.nan_to_num(m, nan=-1e4) for m in camera.undistort_maps())
    return cv2.remap(image, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT).astype(np.uint8)
