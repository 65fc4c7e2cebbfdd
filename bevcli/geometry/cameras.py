"""Camera and CameraRig: projection, lens distortion and undistortion, the only ones in the project.

The camera frame has x right, y down, z forward. Pixel (0, 0) is the centre of the top left pixel, as in OpenCV.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from bevcli.geometry.transforms import Array, apply, inverse, rigid, rotation_about_z, yaw_of_rotation

NEAR_M = 1e-5  # a point with a smaller depth, or behind the camera, has no pixel
WIDEST_ANGLE = np.radians(120)  # off the optical axis, of a ray of a fisheye
ANGLES = 20_000  # of the table that inverts a fisheye's projection
REFINEMENTS = 15  # fixed-point steps that invert a lens distortion
LARGEST_RAY_ERROR = 1e-5  # of a normalised coordinate
OUTSIDE = -1e4  # pixel coordinate outside any image, in place of NaN, which cv2.remap does not accept
BEV_ORIGIN_M = (0.94, 0.0, 1.84)  # of nuScenes' LIDAR_TOP in ego, metres
BEV_ORIGIN = f"({BEV_ORIGIN_M[0]:g}, {BEV_ORIGIN_M[1]:g}, {BEV_ORIGIN_M[2]:g}) m"
NOISE_M = 0.05  # standard deviation per level and axis of `camera_pose_noise`

# Viewing directions of nuScenes' cameras in the ego frame, degrees counter-clockwise from straight ahead.
NUSCENES_YAWS_DEG = {
    "CAM_FRONT": 0.0,
    "CAM_FRONT_RIGHT": -55.0,
    "CAM_FRONT_LEFT": 55.0,
    "CAM_BACK": 180.0,
    "CAM_BACK_LEFT": 110.0,
    "CAM_BACK_RIGHT": -110.0,
}


@dataclass(frozen=True)
class Distortion:
    """Lens distortion, with the models and coefficients of OpenCV.

    Attributes:
        model: "brown_conrady" or the fisheye model "kannala_brandt".
        coefficients: k1 k2 p1 p2 [k3 [k4 k5 k6]] for Brown-Conrady, k1 k2 k3 k4 for Kannala-Brandt.
    """

    model: Literal["brown_conrady", "kannala_brandt"]
    coefficients: tuple[float, ...]


def brown_conrady(coefficients: ArrayLike) -> Distortion | None:
    """The lens with the coefficients k1 k2 p1 p2 k3 k4 k5 k6, or None if all are 0."""
    values = np.asarray(coefficients, dtype=np.float64)
    if not values.any():
        return None
    return Distortion("brown_conrady", tuple(values.tolist() if values[5:].any() else values[:5].tolist()))


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with optional lens distortion.

    Attributes:
        name: the camera's name in its rig.
        width: image width, pixels.
        height: image height, pixels.
        intrinsics: (3, 3) image_from_camera, pixels.
        ego_from_camera: (4, 4) extrinsics, metres.
        distortion: None for a camera without distortion.
    """

    name: str
    width: int
    height: int
    intrinsics: Array
    ego_from_camera: Array
    distortion: Distortion | None = None

    @property
    def camera_from_ego(self) -> Array:
        """(4, 4), metres."""
        return inverse(self.ego_from_camera)

    @property
    def image_from_camera(self) -> Array:
        """(4, 4), without distortion: (u d, v d, d, 1) = image_from_camera @ (x, y, z, 1)."""
        return rigid((0, 0, 0), self.intrinsics)

    @property
    def yaw(self) -> float:
        """Viewing direction in the ego frame, radians counter-clockwise from straight ahead."""
        return float(np.arctan2(self.ego_from_camera[1, 2], self.ego_from_camera[0, 2]))

    def project(self, points_camera: ArrayLike) -> tuple[Array, Array]:
        """Points (..., 3) in the camera frame, metres -> pixels (..., 2) and depths (...,), metres.

        Distortion is applied. Pixels are NaN for a depth of NEAR_M or less, and where the lens model is not valid.
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
        """Points (..., 3) in the ego frame at the camera's time -> pixels and depths as `project`."""
        return self.project(apply(self.camera_from_ego, points_ego))

    def contains(self, pixels: ArrayLike, depth: ArrayLike) -> NDArray[np.bool_]:
        """(...,) bool: whether pixels (..., 2) with depths (...,) are in front of the camera and inside the image."""
        p = np.asarray(pixels, dtype=np.float64)
        with np.errstate(invalid="ignore"):
            inside = (p > 0).all(-1) & (p[..., 0] < self.width) & (p[..., 1] < self.height)
        return inside & (np.asarray(depth) > NEAR_M)

    def sees(self, points_ego: ArrayLike) -> NDArray[np.bool_]:
        """(...,) bool: whether points (..., 3) in the ego frame at the camera's time are inside the image."""
        return self.contains(*self.project_ego(points_ego))

    def scaled(self, factor_x: float, factor_y: float | None = None) -> "Camera":
        """The camera of the resized image. Pixel coordinates are multiplied by the factors, without a half-pixel shift.

        factor_y: equal to `factor_x` by default.
        """
        factors = np.diag([factor_x, factor_x if factor_y is None else factor_y, 1.0])
        width, height = round(self.width * factors[0, 0]), round(self.height * factors[1, 1])
        return replace(self, width=width, height=height, intrinsics=factors @ self.intrinsics)

    def distorted(self, pixels: ArrayLike) -> Array:
        """Pixels (..., 2) of the undistorted image -> the same rays' pixels (..., 2) in the camera's image.

        NaN where the lens model is not valid.
        """
        p = np.asarray(pixels, dtype=np.float64)
        rays = np.concatenate([p, np.ones((*p.shape[:-1], 1))], axis=-1) @ np.linalg.inv(self.intrinsics).T
        return self.project(rays)[0]

    def rays(self, pixels: ArrayLike) -> Array:
        """Pixels (..., 2) -> unit directions (..., 3) in the camera frame, with the lens distortion undone.

        Of a fisheye they may lead backwards. NaN beyond `WIDEST_ANGLE`, and where the lens model is not valid.
        """
        p = np.asarray(pixels, dtype=np.float64)
        bent = (p - self.intrinsics[:2, 2]) @ np.linalg.inv(self.intrinsics[:2, :2]).T
        if self.distortion is not None and self.distortion.model == "kannala_brandt":
            return _kannala_brandt_directions(bent, self.distortion.coefficients)
        flat = bent if self.distortion is None else _undistorted(bent, self.distortion)
        directions = np.concatenate([flat, np.ones((*p.shape[:-1], 1))], axis=-1)
        return directions / np.linalg.norm(directions, axis=-1, keepdims=True)

    def undistort(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The image (H, W, 3) that a pinhole camera with the same intrinsics would have taken.

        It is black where the lens saw nothing. An image of a camera without distortion is returned as it is.
        """
        if self.distortion is None:
            return image
        undistorted = cv2.remap(image, *self._undistortion_maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        return undistorted.astype(np.uint8, copy=False)

    @cached_property
    def _undistortion_maps(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """(H, W) x and (H, W) y of cv2.remap. They are kept, because they cost far more than the remapping."""
        u, v = np.meshgrid(np.arange(self.width, dtype=np.float64), np.arange(self.height, dtype=np.float64))
        source = np.nan_to_num(self.distorted(np.stack([u, v], axis=-1)).astype(np.float32), nan=OUTSIDE)
        return np.ascontiguousarray(source[..., 0]), np.ascontiguousarray(source[..., 1])


@dataclass(frozen=True)
class CameraRig:
    """The cameras of a vehicle, and the frame in which the model predicts.

    Attributes:
        cameras: the cameras, in the calibration's order.
        ego_from_bev: (4, 4), metres.
        ego_from_bev_assumed: whether `ego_from_bev` is the default because the calibration does not state it.
    """

    cameras: tuple[Camera, ...]
    ego_from_bev: Array
    ego_from_bev_assumed: bool = False

    def __repr__(self) -> str:
        return "CameraRig(" + ", ".join(f"{c.name} {c.width}x{c.height}" for c in self.cameras) + ")"

    @property
    def names(self) -> tuple[str, ...]:
        """The cameras' names, in the rig's order."""
        return tuple(camera.name for camera in self.cameras)

    def __getitem__(self, name: str) -> "Camera":
        return next(camera for camera in self.cameras if camera.name == name)


def default_ego_from_bev() -> Array:
    """(4, 4) of a level frame like nuScenes' LIDAR_TOP: x right, y forward, origin at BEV_ORIGIN_M in ego."""
    return rigid(BEV_ORIGIN_M, [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def level_rig(rig: CameraRig, height_m: float, road_normal: Array | None = None) -> CameraRig:
    """The rig with a level bev frame at a height above the ground, with the origin and heading of the rig's.

    The ground is the plane z = 0 of the ego frame, or that with another normal (3,), a unit vector in the ego frame,
    which meets it under the bev frame's origin. A rig whose bev frame is so already is returned as it is.
    """
    given = rig.ego_from_bev
    level = rigid((*given[:2, 3], height_m), rotation_about_z(yaw_of_rotation(given[:3, :3])))
    if road_normal is not None:
        left = np.cross(road_normal, (1.0, 0.0, 0.0)) / np.hypot(*road_normal[1:])
        turn = np.stack([np.cross(left, road_normal), left, road_normal], axis=1)
        level = rigid((*given[:2, 3], 0.0) + height_m * road_normal, turn @ level[:3, :3])
    return rig if np.allclose(level, given, rtol=0, atol=1e-6) else replace(rig, ego_from_bev=level)


def distort(rays: ArrayLike, distortion: Distortion) -> Array:
    """Normalised pinhole coordinates (..., 2) -> distorted coordinates (..., 2).

    The result is NaN where the input is, and beyond the angle at which the lens model stops being monotonic.
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
    bent_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    bent_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    with np.errstate(invalid="ignore"):
        return np.where((slope > 0)[..., None], np.stack([bent_x, bent_y], axis=-1), np.nan)


def _undistorted(bent: Array, distortion: Distortion) -> Array:
    """Distorted coordinates (..., 2) -> normalised pinhole coordinates (..., 2); NaN where no ray is found.

    OpenCV's solution alone is off by some pixels at strong distortion, so it is refined.
    """
    if not bent.size:  # OpenCV 4 refuses it
        return bent
    solved = cv2.undistortPoints(bent.reshape(-1, 1, 2), np.eye(3), np.array(distortion.coefficients))
    rays = np.asarray(solved, dtype=np.float64).reshape(bent.shape)
    for _ in range(REFINEMENTS):
        rays = rays + (bent - distort(rays, distortion))
    error = np.abs(distort(rays, distortion) - bent).max(-1, keepdims=True)
    return np.where(error < LARGEST_RAY_ERROR, rays, np.nan)


def fisheye_table(coefficients: tuple[float, ...]) -> tuple[Array, Array]:
    """Rising angles (A,) off the optical axis, and the normalised radii (A,) at which a Kannala-Brandt lens shows them.

    The last angle is WIDEST_ANGLE, or that at which the lens model stops being monotonic.
    """
    angles = np.linspace(0, WIDEST_ANGLE, ANGLES)
    radii = angles + sum(k * angles ** (2 * i + 3) for i, k in enumerate(coefficients))
    falls = np.flatnonzero(np.diff(radii) <= 0)
    end = int(falls[0]) + 1 if len(falls) else ANGLES
    return angles[:end], radii[:end]


def _kannala_brandt_directions(bent: Array, coefficients: tuple[float, ...]) -> Array:
    """Distorted coordinates (..., 2) of a fisheye -> unit directions (..., 3)."""
    angles, radii = fisheye_table(coefficients)
    radius = np.linalg.norm(bent, axis=-1)
    angle = np.interp(radius, radii, angles, right=np.nan)
    side = np.sin(angle) / np.where(radius > 0, radius, 1.0)
    return np.concatenate([bent * side[..., None], np.cos(angle)[..., None]], axis=-1)


def camera_pose_noise(level: float, random: np.random.Generator) -> Array:
    """(4, 4) camera_from_noisy_camera, metres.

    Level L has normal noise on each axis: rotation with a variance of L degrees², translation with a standard deviation
    of 5 L cm. BEVFormer's paper has the levels 1 to 4.
    """
    rotation_deg = np.sqrt(level) * random.standard_normal(3)
    translation = NOISE_M * level * random.standard_normal(3)
    rotation, _ = cv2.Rodrigues(np.radians(rotation_deg))
    return rigid(translation, rotation)
