"""The views of one frame: its images, their features, the road from above."""

from collections.abc import Callable, Sequence as Items
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.frame import Frame
from bevcli.geometry.cameras import OUTSIDE, Camera, CameraRig
from bevcli.geometry.transforms import Array
from bevcli.workshop.correspondence.images import GreyImage, grey_image, reduced, texture
from bevcli.workshop.correspondence.points import Features, features
from bevcli.workshop.correspondence.road import sampled

CELL_M = 0.08
BEGIN_M, SHAPE = (-24.0, -9.0), (225, 640)  # the smallest x and y; cells along y and x
SLOPE_STEP, KEPT = np.radians(0.25), 3  # of grids, of which the last ones are kept
MOST_BLUR_M = 0.45  # of the road in one pixel, along the ray
MARGIN = 9  # cells, between cameras


@dataclass(frozen=True)
class RoadPicture:
    """The road around the vehicle in the ego frame; rows along y, columns along x."""

    texture: NDArray[np.uint8]  # (225, 640), 128 where nothing is seen
    seen: NDArray[np.bool_]  # (225, 640)
    of: NDArray[np.int8]  # (225, 640) the camera of each cell, -1 for none
    slopes: Array  # (2,) of the road along x and y


def nearest_cameras(cameras: Items[Camera], points: Array) -> tuple[list[NDArray[np.float32]], NDArray[np.int8], Array]:
    """The cameras that see points (H, W, 3) of the road sharply, ego frame.

    Returns the pixels (H, W, 2) of the points in each camera; the index (H, W) of the nearest one that sees them, -1
    where none does; and the distance (H, W) to it.
    """
    maps, distances = [], []
    for camera in cameras:
        pixels, depth = camera.project_ego(points)
        away = np.linalg.norm(points - camera.ego_from_camera[:3, 3], axis=-1)
        blur = away**2 / max(camera.ego_from_camera[2, 3] * camera.intrinsics[0, 0], 1e-3)
        usable = camera.contains(pixels, depth) & (blur < MOST_BLUR_M)
        distances.append(np.where(usable, away, np.inf))
        maps.append(np.nan_to_num(pixels, nan=OUTSIDE).astype(np.float32))
    nearest, distance = np.argmin(distances, axis=0), np.min(distances, axis=0)
    return maps, np.where(np.isinf(distance), -1, nearest).astype(np.int8), distance


class RoadGrid:
    """The cells of a road picture, of a road with slopes along x and y of the ego frame, in the images of a rig."""

    def __init__(self, cameras: Items[Camera], slope_x: float, slope_y: float) -> None:
        self._slopes = np.array([slope_x, slope_y])
        rows, columns = np.indices(SHAPE)
        x, y = BEGIN_M[0] + CELL_M * columns, BEGIN_M[1] + CELL_M * rows
        points = np.stack([x, y, slope_x * x + slope_y * y], axis=-1)
        self._maps, self._of, _ = nearest_cameras(cameras, points)

    def picture(self, images: Items[GreyImage | None]) -> RoadPicture:
        """The road in the images of a frame."""
        grey, seen = np.zeros(SHAPE, dtype=np.float32), np.zeros(SHAPE, dtype=bool)
        for index, (image, pixels) in enumerate(zip(images, self._maps, strict=True)):
            mine = self._of == index
            if image is None or not mine.any():
                continue
            grey[mine] = sampled(image.pixels, pixels)[mine]
            seen |= cv2.erode(mine.astype(np.uint8), np.ones((MARGIN, MARGIN))) > 0
        return RoadPicture(texture(grey, seen), seen, self._of, self._slopes)


def moved_picture(picture: RoadPicture, yaw: float, shift: Array) -> RoadPicture:
    """The picture in a frame; its points are turned by a yaw and then shifted (2,) to be those of the picture's."""
    c, s = np.cos(yaw), np.sin(yaw)
    turn, begin = np.array([[c, -s], [s, c]]), np.array(BEGIN_M)
    matrix = np.column_stack([turn, (turn @ begin + shift - begin) / CELL_M])
    size, inverse = SHAPE[::-1], cv2.WARP_INVERSE_MAP
    grey = cv2.warpAffine(picture.texture, matrix, size, flags=inverse | cv2.INTER_LINEAR, borderValue=128)
    seen = cv2.warpAffine(picture.seen.astype(np.uint8), matrix, size, flags=inverse | cv2.INTER_NEAREST)
    return replace(picture, texture=np.asarray(grey, dtype=np.uint8), seen=seen > 0)


PIXELS, WIDEST = 1.8e6, 1250  # of all reduced images of a frame together, and the width of one


@dataclass(frozen=True)
class FrameView:
    """The views of one frame."""

    timestamp_ns: int
    cameras: tuple[Camera, ...]  # of the reduced images
    late_s: Array  # (C,) when each image was taken, after the frame's time
    images: tuple[GreyImage | None, ...]  # None: no image, or one that shows nothing
    features: tuple[Features | None, ...]
    grid: Callable[[float, float], RoadGrid]  # of a road with these slopes

    def road(self, slopes: Array) -> RoadPicture:
        """The road seen from above, of slopes (2,) in the ego frame, rounded to steps of SLOPE_STEP."""
        x, y = (float(round(slope / SLOPE_STEP) * SLOPE_STEP) for slope in slopes)
        return self.grid(x, y).picture(self.images)


class Viewer:
    """Makes the views of frames. What depends on the rig alone is kept."""

    def __init__(self) -> None:
        self._rig: CameraRig | None = None

    def view(self, frame: Frame) -> FrameView:
        """The views of a frame."""
        if frame.rig is not self._rig:
            self._rig, self._cameras = frame.rig, _reduced(frame.rig)
            self._grid = lru_cache(maxsize=KEPT)(partial(RoadGrid, self._cameras))
        time, cameras = frame.stamp.timestamp_ns, self._cameras
        shown = [frame.images.get(camera.name) for camera in cameras]
        taken = [time if image is None else image.timestamp_ns for image in shown]
        images = tuple(
            None if image is None else grey_image(image.pixels_bgr, camera)
            for image, camera in zip(shown, cameras, strict=True)
        )
        described = tuple(None if image is None else features(image) for image in images)
        return FrameView(time, cameras, (np.array(taken) - time) / 1e9, images, described, self._grid)


def _reduced(rig: CameraRig) -> tuple[Camera, ...]:
    """The cameras of the reduced images."""
    wide = sum(camera.height / camera.width for camera in rig.cameras)  # pixels of all for a width of one pixel
    width = min(WIDEST, int(np.sqrt(PIXELS / wide)))
    return tuple(reduced(camera, min(width, camera.width)) for camera in rig.cameras)
