"""The rigs that are rendered, and the pinhole images from which the image of a camera with distortion is resampled.

A rig is the default one, one from a file, or one drawn at random for training and validation.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
from msgspec import Meta
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline

from bevcli.errors import InputError
from bevcli.geometry.cameras import OUTSIDE, Camera, CameraRig, Distortion, default_ego_from_bev, fisheye_table
from bevcli.geometry.transforms import Array, rigid, rotation_about_z
from bevcli.parsing.documents import Share
from bevcli.sequences.files.calibration_file import read_calibration
from bevcli.workshop.synth import Body

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

    Columns and rows are OUTSIDE for pixels that another part gives, or none.
    """

    pinhole: Camera
    columns: NDArray[np.float32]  # (H, W) in the pinhole image, for each pixel of the camera's image
    rows: NDArray[np.float32]  # (H, W)
    needed: NDArray[np.uint8]  # (H', W') 1 for the pixels of the pinhole image that are needed, else 0


def lens_parts(camera: Camera) -> tuple[LensPart, ...]:
    """The pinhole images that give the image of a camera with distortion: a wider one, or up to five for a fisheye.

    They cost as much as rendering the image, so keep them for all frames.
    Raises InputError where a lens that is not "kannala_brandt" sees more than about 75 degrees off its optical axis,
    where the model of a fisheye ends within the image at a smaller angle, and where the whole image would be black.
    """
    assert camera.distortion is not None
    u, v = np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64)
    some_u, some_v = (np.linspace(0, p[-1], max(len(p) // STEP, 4)) for p in (u, v))
    directions = _directions(camera, some_u, some_v)
    if (np.abs(directions[..., :2]) <= WIDEST * directions[..., 2:]).all():
        some = directions[..., :2] / directions[..., 2:]
        interpolated = [RectBivariateSpline(some_v, some_u, some[..., axis])(v, u) for axis in range(2)]
        return (_part(camera, FACES[0], interpolated),)
    if camera.distortion.model != "kannala_brandt":
        raise InputError(
            "its field of view is too wide to be rendered (expected at most 75 degrees off the optical axis, or a "
            '"kannala_brandt" lens): remove "distortion" from the rig or use a narrower lens'
        )
    directions = _directions(camera, u, v)  # NaN where the image is black
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


def _directions(camera: Camera, u: Array, v: Array) -> Array:
    """(V, U, 3) in the camera frame, of the pixels in columns (U,) and rows (V,)."""
    return camera.rays(np.stack(np.meshgrid(u, v), -1))


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
    inside = columns >= 0
    used = np.zeros((height, width), np.uint8)
    used[rows[inside].astype(np.int64), columns[inside].astype(np.int64)] = 1
    needed = cv2.dilate(used, np.ones((2, 2), np.uint8), anchor=(1, 1))  # with the pixels at the right and below
    return LensPart(pinhole, columns, rows, needed.astype(np.uint8, copy=False))


# name: x, y, z in the ego frame (metres), yaw (degrees), focal length (pixels at 1600 x 900)
_MOUNTS = {
    "CAM_FRONT": (1.72, 0.0, 1.50, 0.0, 1266.0),
    "CAM_FRONT_RIGHT": (1.58, -0.50, 1.51, -56.0, 1260.0),
    "CAM_FRONT_LEFT": (1.58, 0.50, 1.51, 56.0, 1260.0),
    "CAM_BACK": (0.05, 0.0, 1.57, 180.0, 809.0),
    "CAM_BACK_LEFT": (1.05, 0.48, 1.56, 109.0, 1256.0),
    "CAM_BACK_RIGHT": (1.05, -0.48, 1.56, -111.0, 1256.0),
}
EGO_AXES_FROM_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # of one that looks ahead


def nuscenes_like_rig(width: int = 1600, height: int = 900) -> CameraRig:
    """Six horizontal cameras around the vehicle. width, height: of the images, pixels; the fields of view stay."""
    cameras = []
    for name, (*position, yaw_deg, focal) in _MOUNTS.items():
        intrinsics: Array = np.array([[focal, 0, 800.0], [0, focal, 450.0], [0, 0, 1.0]])
        rotation = rotation_about_z(np.radians(yaw_deg)) @ EGO_AXES_FROM_CAMERA
        camera = Camera(name, 1600, 900, intrinsics, rigid(position, rotation))
        cameras.append(camera.scaled(width / 1600, height / 900))
    return CameraRig(tuple(cameras), default_ego_from_bev())


def rig_for_rendering(rig: str | Path | CameraRig | None, size: tuple[int, int] | None) -> CameraRig:
    """The cameras to render.

    rig: a rig, or the path of a calibration.json; default: `nuscenes_like_rig`. size: width and height of the images,
    pixels; default: that of the rig.
    Raises InputError where the file is wrong, or a camera has too wide a field of view for its lens model.
    """
    if rig is None:
        source, chosen = "", nuscenes_like_rig()
    elif isinstance(rig, CameraRig):
        source, chosen = "rig: ", rig
    else:
        source, chosen = f"{rig}: ", read_calibration(Path(rig))
    if size is not None:
        chosen = replace(chosen, cameras=tuple(c.scaled(size[0] / c.width, size[1] / c.height) for c in chosen.cameras))
    for camera in chosen.cameras:
        if camera.distortion is not None:
            try:
                lens_parts(camera)
            except InputError as error:
                raise InputError(f"{source}camera {camera.name}: {error}") from None
    return chosen


MATERIAL_FILES = ("models/*-*.npz", "skies/*.png", "textures/*-*.png")
_STREAM = 0x7269_6773  # keeps the draws apart from those of the street with the same seed
_CENTER_X_M = 1.4  # middle of the vehicle, ahead of the rear axle
Range = tuple[float, float]
CameraCount = Annotated[int, Meta(ge=1, le=16)]
FieldOfView = Annotated[float, Meta(ge=10, le=140)]
Quality = Annotated[int, Meta(ge=1, le=100)]
Aspect = Annotated[float, Meta(ge=0.3, le=4)]


@dataclass(frozen=True)
class RigDistribution:
    """The [training.rigs] table: the distribution of the rigs, and of how their images were taken.

    A share is a probability from 0 to 1. A range is the lowest and the highest value, drawn uniformly.
    """

    random_share: Share = 0.0  # share of the drives with a random rig; the others have the default rig
    cameras: tuple[CameraCount, CameraCount] = (4, 8)  # number of cameras
    # horizontal; rigs that look all around get enough to leave no gap, if possible
    fov_deg: tuple[FieldOfView, FieldOfView] = (45.0, 110.0)
    fov_spread: float = 0.2  # cameras of a rig differ in it by a factor of at most 1 + this, up or down
    # width / height of the images
    aspects: tuple[Aspect, ...] = (1.778, 1.6, 1.5, 1.333, 1.25, 1.9)
    focal_ratio: float = 0.02  # largest relative difference of the focal lengths along x and y
    principal_point: float = 0.06  # largest distance from the image centre, relative to width and height
    height_m: Range = (0.8, 2.8)  # of the cameras above the ground; those of a rig differ by at most 0.15 m
    radius_m: Range = (0.2, 1.8)  # distance from the middle of the roof, along x; half of it along y
    front_share: Share = 0.2  # share of the rigs that look ahead and to the sides only
    yaw_jitter_deg: float = 12.0  # largest deviation of a camera from even spacing
    tilt_deg: float = 3.0  # largest pitch and roll of a camera
    bev_tilt_deg: float = 2.0  # largest pitch and roll of the bev frame
    bev_height_m: Range = (0.0, 2.5)  # height of the bev frame's origin above the ground
    distorted_share: Share = 0.2  # share of the rigs with lens distortion
    delayed_share: Share = 0.4  # share of the rigs whose cameras take their images at different times
    delay_s: Annotated[float, Meta(ge=0, le=0.1)] = 0.05  # largest time of an image after that of its frame
    supersampled_share: Share = 0.5  # share of the rigs whose images are anti-aliased, by 2 x 2 samples a pixel
    coarse_share: Share = 0.15  # share of the rigs with images of a lower resolution than the model's,
    coarsest: Annotated[float, Meta(ge=0.1, le=1)] = 0.6  # by a factor from this to 1
    jpeg_quality: tuple[Quality, Quality] = (60, 95)
    moving_share: Share = 0.0  # share of the drives whose body pitches and rolls
    unstated_share: Share = 0.5  # share of those with level poses, which do not state it
    varied_share: Share = 0.0  # share of the drives with varied shapes, colours, patterns, light, nameless objects
    material: str = ""  # folder of models and photographs for these drives (`MaterialFolder`); "" for none

    def __post_init__(self) -> None:
        for name in ("cameras", "fov_deg", "height_m", "radius_m", "bev_height_m", "jpeg_quality"):
            low, high = getattr(self, name)
            if low > high:
                raise ValueError(f"{name} goes from a smaller to a larger number")
        if not self.aspects:
            raise ValueError("aspects must not be empty")
        if self.material and not self.varied_share:
            raise ValueError("material is for drives with varied looks: varied_share must be above 0")

    @property
    def digest(self) -> str:
        """Eight hexadecimal digits that differ between distributions and, by names and sizes, files of the material.

        Raises InputError where the material's folder is missing or holds nothing of use.
        """
        new = {"moving_share", "unstated_share"} if not self.moving_share else set()  # older caches stay valid
        new |= {"material"} if self.varied_share else {"material", "varied_share"}
        values = tuple(value for name, value in vars(self).items() if name not in new)
        if self.material:
            files = material_files(self.material)
            values += tuple((path.parent.name, path.name, path.stat().st_size) for path in files)
        return hashlib.sha256(repr(values).encode()).hexdigest()[:8]


def material_files(folder: str) -> list[Path]:
    """The files of a folder that a `MaterialFolder` reads, in a fixed order. Raises InputError where there are none."""
    files = [path for pattern in MATERIAL_FILES for path in sorted(Path(folder).glob(pattern))]
    if not files:
        found = "holds none of them" if Path(folder).is_dir() else "there is no such folder"
        raise InputError(
            f"{folder}: {found} (expected {', '.join(MATERIAL_FILES)}): correct `material` in [training.rigs]"
        )
    return files


@dataclass(frozen=True)
class DrawnRig:
    """The rig of a drive, and how its images are taken."""

    rig: CameraRig
    delays_s: dict[str, float] = field(default_factory=dict)  # camera -> time of its images after the frame's
    supersampling: int = 1  # samples per pixel along each axis
    jpeg_quality: int = 90  # 1 to 100
    body: Body = "still"  # of the vehicle
    varied: bool = False  # whether the looks of the drive are varied
    material: str = ""  # folder of what they are varied with (`MaterialFolder`); "" for none


def draw_rig(distribution: RigDistribution, seed: int, size: tuple[int, int]) -> DrawnRig:
    """The rig of a seed: the default one, or a random one.

    size: (width, height) in pixels of the largest images; those of another aspect ratio fit inside.
    """
    random = np.random.default_rng([seed, _STREAM])
    is_random = random.random() < distribution.random_share
    coarse = random.uniform(distribution.coarsest, 1) if random.random() < distribution.coarse_share else 1.0
    samples = 2 if random.random() < distribution.supersampled_share else 1
    quality = int(random.integers(distribution.jpeg_quality[0], distribution.jpeg_quality[1] + 1))
    rig = nuscenes_like_rig(round(size[0] * coarse), round(size[1] * coarse))
    if is_random:
        rig = _random_rig(distribution, size, coarse, random)
    delays = {}
    if random.random() < distribution.delayed_share:
        delays = {name: round(float(random.uniform(0, distribution.delay_s)), 3) for name in rig.names}
    varied = np.random.default_rng([seed, _STREAM, 1]).random() < distribution.varied_share  # leaves the rest as it is
    moves, unstated = np.random.default_rng([seed, _STREAM, 2]).random(2)
    body: Body = "moving" if unstated >= distribution.unstated_share else "unstated"
    body = body if moves < distribution.moving_share else "still"
    return DrawnRig(rig, delays, samples, quality, body, bool(varied), distribution.material if varied else "")


def _random_rig(distribution: RigDistribution, size: tuple[int, int], coarse: float, random: Generator) -> CameraRig:
    count = int(random.integers(distribution.cameras[0], distribution.cameras[1] + 1))
    aspect = float(random.choice(distribution.aspects))
    ahead_only = random.random() < distribution.front_share
    yaws, spacing_deg = _yaws_deg(count, ahead_only, distribution, random)
    low, high = distribution.fov_deg
    fov_deg = random.uniform(min(max(low, spacing_deg), high), high)
    height, radius = random.uniform(*distribution.height_m), random.uniform(*distribution.radius_m)
    coefficients = random.uniform(-1, 1, 4) * (0.12, 0.02, 0.002, 0.002) + (-0.12, 0.03, 0, 0)  # k1, k2, p1, p2
    is_distorted = random.random() < distribution.distorted_share
    width_px = min(size[0], size[1] * aspect) * coarse
    image_size = max(round(width_px), 16), max(round(width_px / aspect), 16)
    cameras = []
    for index, yaw_deg in enumerate(yaws):
        spread = random.uniform(-1, 1)
        camera_fov = float(np.clip(fov_deg * (1 + distribution.fov_spread) ** spread, *distribution.fov_deg))
        intrinsics = _intrinsics(image_size, camera_fov, distribution, random)
        around = np.radians(yaw_deg + random.uniform(-20, 20))  # on an ellipse around the middle of the vehicle
        x, y = _CENTER_X_M + radius * np.cos(around), 0.5 * radius * np.sin(around)
        position = (x, y, np.clip(height + random.uniform(-0.15, 0.15), *distribution.height_m))
        tilt = _tilt(distribution.tilt_deg, random)
        rotation = rotation_about_z(np.radians(yaw_deg)) @ tilt @ EGO_AXES_FROM_CAMERA
        distortion = _fitting(coefficients, intrinsics, image_size) if is_distorted else None
        cameras.append(Camera(f"CAM_{index}", *image_size, intrinsics, rigid(position, rotation), distortion))
    tilt = _tilt(distribution.bev_tilt_deg, random)
    # Of the bev frame: near the middle of the vehicle, x to the right.
    origin = (random.uniform(0.5, 1.5), random.uniform(-0.1, 0.1), random.uniform(*distribution.bev_height_m))
    heading = rotation_about_z(-np.pi / 2 + np.radians(random.uniform(-1, 1)))
    return CameraRig(tuple(cameras), rigid(origin, tilt @ heading))


def _yaws_deg(
    count: int, ahead_only: bool, distribution: RigDistribution, random: Generator
) -> tuple[list[float], float]:
    """Yaw of each camera, and the angle between the axes of neighbours; degrees."""
    jitter = random.uniform(-1, 1, count) * distribution.yaw_jitter_deg
    if ahead_only:
        arc = random.uniform(140, 220)
        return [float(yaw) for yaw in np.linspace(-arc / 2, arc / 2, count) + jitter], arc / max(count - 1, 1)
    # A camera looks straight ahead, or two look past it.
    first = 0.0 if random.random() < 0.75 else 180 / count
    return [float(yaw) for yaw in first + np.arange(count) * 360 / count + jitter], 360 / count


def _intrinsics(size: tuple[int, int], fov_deg: float, distribution: RigDistribution, random: Generator) -> Array:
    width, height = size
    focal = width / 2 / np.tan(np.radians(fov_deg) / 2)
    ratio = 1 + random.uniform(-1, 1) * distribution.focal_ratio
    x, y = 0.5 + random.uniform(-1, 1, 2) * distribution.principal_point
    return np.array([[focal, 0, x * width], [0, focal * ratio, y * height], [0, 0, 1.0]])


def _fitting(coefficients: Array, intrinsics: Array, size: tuple[int, int]) -> Distortion:
    """The distortion, weaker for wide lenses: as at a field of view of 70 degrees in the corner of the image."""
    corner = np.hypot(size[0] / intrinsics[0, 0], size[1] / intrinsics[1, 1]) / 2
    weaker = min(1.0, (0.7 / corner) ** 2)
    k1, k2, p1, p2 = coefficients
    scaled = (k1 * weaker, k2 * weaker**2, p1 * weaker, p2 * weaker)
    return Distortion("brown_conrady", tuple(float(k) for k in scaled))


def _tilt(largest_deg: float, random: Generator) -> Array:
    return tilt(*np.radians(random.uniform(-1, 1, 2) * largest_deg))


def tilt(pitch: float, roll: float) -> Array:
    """(3, 3) rotation by a pitch about y (nose down) and a roll about x (right side down), radians, x forward."""
    about_y = np.array([[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0], [-np.sin(pitch), 0, np.cos(pitch)]])
    about_x = np.array([[1, 0, 0], [0, np.cos(roll), -np.sin(roll)], [0, np.sin(roll), np.cos(roll)]])
    return np.asarray(about_y @ about_x)
