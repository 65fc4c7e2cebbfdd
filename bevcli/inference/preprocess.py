"""From a frame to the network's input, and from boxes in that input back to the cameras' images.

Images are resized only here, together with their calibration.
"""

import os
import warnings
import weakref
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.frame import CameraImage, ColorOrder, Frame
from bevcli.geometry.boxes import Boxes2D
from bevcli.geometry.cameras import Camera, CameraRig, level_rig
from bevcli.geometry.transforms import Array, inverse
from bevcli.inference.image_repair import repaired
from bevcli.jit import njit
from bevcli.model.config import ImageConfig, ModelConfig
from bevcli.model.image_boxes import IMAGE_CLASSES, ImageBoxes
from bevcli.model.road_slopes import GreyView
from bevcli.model.step import CameraAssignment, PreparedFrame, assign_cameras

GREY_WIDTH = 352  # pixels of the images in which points are followed
WriteImage = Callable[[NDArray[np.uint8], ImageConfig, NDArray[Any]], None]  # (H, W, 3), size and mean, (3, H', W')
LEAST_SCORE = 0.05  # what is scored below is nothing
POINTS_OF_SIDE = 9  # of a box that is bent by a lens; the rectangle around them is the box


class Preprocessor:
    """Prepares the frames of a sequence for one model, with threads of its own that end with it.

    Args:
        chosen_cameras: camera -> model camera whose embedding it uses. Others are assigned by viewing direction.
        threads: 1 for that of the caller, None for one a processor core.
        write: writes an image as the network takes it to the top left corner of (3, H, W) zeros of `dtype`. Default:
            `write_network_image`.
        pixels: prepares images for an exported file: see `PreparedFrame.pixels`.
    """

    def __init__(
        self,
        config: ModelConfig,
        chosen_cameras: Mapping[str, str] | None = None,
        *,
        threads: int | None = None,
        write: WriteImage | None = None,
        dtype: type[np.generic] = np.float32,
        pixels: bool = False,
    ) -> None:
        self.config, self.pixels = config, pixels
        self._chosen_cameras = chosen_cameras
        self._write, self._dtype = write or write_network_image, dtype
        self._of_rig: _OfRig | None = None  # replaced as a whole: frames may be prepared in several threads
        # In sequence, preparing the images takes longer than the model on a GPU.
        self._threads: ThreadPoolExecutor | None = None
        if threads != 1:
            self._threads = ThreadPoolExecutor(threads or os.cpu_count() or 1, thread_name_prefix="preprocess")
            weakref.finalize(self, self._threads.shutdown, wait=False)

    def __call__(self, frame: Frame) -> PreparedFrame:
        """The frame with its images undistorted, resized, normalised and padded, and the matching projections."""
        rig_facts, bev_frame = self._of_rig, self.config.bev_frame
        if rig_facts is None or rig_facts.rig is not frame.rig:
            model_rig = level_rig(frame.rig, bev_frame.height_m) if bev_frame.level else frame.rig
            assignment = assign_cameras(frame.rig, self.config.cameras, self._chosen_cameras)
            image = image_for_rig(frame.rig, self.config.image)
            if self.pixels:
                image = replace(image, mean=(0, 0, 0), std=(1, 1, 1), color_order="bgr")
            rig_facts = self._of_rig = _OfRig(frame.rig, model_rig, assignment, image)
        model_rig = rig_facts.model_rig
        if bev_frame.level and bev_frame.follow_road:
            model_rig = level_rig(frame.rig, bev_frame.height_m, frame.road_normal)
        frame = frame if frame.rig is model_rig else replace(frame, rig=model_rig)
        image, assignment = rig_facts.image, rig_facts.assignment
        names = assignment.cameras
        width, height = image.padded_size
        # Channels last, as convolutions read them. Not torch.zeros: PyTorch's operations would start threads of OpenMP
        # here, and where it has more threads than there are processors, those of the model no longer spin.
        empty = np.zeros((1, len(names), height, width, 3), self._dtype)
        if self.pixels:
            empty[:] = self.config.image.pad_bgr
        images = torch.from_numpy(empty).movedim(-1, 2)

        greys = dict.fromkeys(names, np.zeros((0, 0), np.uint8)) if self.config.levels else {}

        def write(camera: int, name: str) -> None:
            pixels = frame.rig[name].undistort(frame.images[name].pixels_bgr)
            if greys:
                greys[name] = small_grey(pixels, image)
            self._write(repaired(pixels, image), image, images[0, camera].numpy())

        present = [(camera, name) for camera, name in enumerate(names) if name in frame.images]
        if self._threads is None:
            for camera, name in present:
                write(camera, name)
        else:
            for task in wait([self._threads.submit(write, *camera) for camera in present]).done:
                task.result()
        scales = tuple(network_scale(frame.rig[name], image) for name in names)
        projections = [network_from_image(frame.rig[name], image) @ image_from_bev(frame, name) for name in names]
        return PreparedFrame(
            frame=frame,
            assignment=assignment,
            scales=scales,
            images=images,
            image_from_bev=torch.from_numpy(np.stack(projections))[None],
            camera_index=torch.tensor([self.config.cameras.index(name) for name in assignment.embeddings]),
            has_image=torch.tensor([[name in frame.images for name in names]]),
            pixels=self.pixels,
            grey=grey_view(frame, greys) if greys else None,
        )


class _OfRig(NamedTuple):
    """What all frames of a rig share. model_rig: the rig in the model's bev frame."""

    rig: CameraRig
    model_rig: CameraRig
    assignment: CameraAssignment
    image: ImageConfig


def image_for_rig(rig: CameraRig, image: ImageConfig) -> ImageConfig:
    """The `ImageConfig` of a rig, with a size of its own where the model has a `focal_px`.

    The size is then the smallest that holds all resized images. They fit inside `image.size`, or are larger by one
    factor for all cameras, at most up to `focal_px` and `max_pixels`.
    """
    if image.focal_px is None or image.max_pixels is None or not rig.cameras:
        return image
    enlargement = rig_enlargement(rig, image)
    return replace(image, size=_common_size(rig, image, enlargement), focal_px=None, max_pixels=None)


def rig_enlargement(rig: CameraRig, image: ImageConfig) -> float:
    """Factor, at least 1, by which the images of a rig are larger than inside `image.size`: see `image_for_rig`."""
    if image.focal_px is None or image.max_pixels is None or not rig.cameras:
        return 1.0
    focal = np.median([network_scale(camera, image) * camera.intrinsics[0, 0] for camera in rig.cameras])
    width, height = _common_size(rig, image, 1.0)
    affordable = np.sqrt(image.max_pixels / (len(rig.cameras) * width * height))
    return float(max(1.0, min(image.focal_px / focal, affordable)))


def _common_size(rig: CameraRig, image: ImageConfig, enlargement: float) -> tuple[int, int]:
    """(width, height) of the smallest image that holds every camera's, each scaled to fit and then enlarged."""
    scales = [enlargement * network_scale(camera, image) for camera in rig.cameras]
    width = max(round(scale * camera.width) for scale, camera in zip(scales, rig.cameras, strict=True))
    height = max(round(scale * camera.height) for scale, camera in zip(scales, rig.cameras, strict=True))
    return width, height


def network_scale(camera: Camera, image: ImageConfig) -> float:
    """Pixels of the resized image per pixel of the camera's: the largest scale at which it fits the model's size."""
    return min(image.size[0] / camera.width, image.size[1] / camera.height)


def network_from_image(camera: Camera, image: ImageConfig) -> Array:
    """(4, 4) float64: homogeneous pixels (u·d, v·d, d, 1) of the camera's image to those of the network's input."""
    scale = network_scale(camera, image)
    matrix = np.diag([scale, scale, 1.0, 1.0])
    matrix[:2, 2] = resize_shift(scale, image) - np.array(image.crop_box[:2])
    return matrix


def resize_shift(scale: float, image: ImageConfig) -> float:
    """Pixels of the resized image that are added to scaled pixel coordinates: see `ImageConfig.half_pixel_shift`."""
    return (scale - 1) / 2 if image.half_pixel_shift else 0.0


def small_grey(pixels_bgr: NDArray[np.uint8], image: ImageConfig) -> NDArray[np.uint8]:
    """An undistorted image (H, W, 3) in grey, (h, w), at most as large as the network's."""
    height, width = pixels_bgr.shape[:2]
    scale = min(image.size[0] / width, image.size[1] / height) * min(GREY_WIDTH / image.size[0], 1.0)
    size = max(round(scale * width), 1), max(round(scale * height), 1)
    grey = cv2.cvtColor(pixels_bgr, cv2.COLOR_BGR2GRAY)
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.uint8)


def grey_view(frame: Frame, greys: Mapping[str, NDArray[np.uint8]]) -> GreyView:
    """Images of `small_grey` by camera, empty where there is none, in the frame's bev frame."""
    projections = []
    for name, grey in greys.items():
        camera = frame.rig[name]
        scale = np.array([grey.shape[1] / camera.width, grey.shape[0] / camera.height]) if grey.size else np.ones(2)
        grey_from_image = np.diag([*scale, 1.0, 1.0])
        grey_from_image[:2, 2] = (scale - 1) / 2
        projections.append(grey_from_image @ image_from_bev(frame, name))
    images = tuple(map(torch.from_numpy, greys.values()))
    return GreyView(images, *map(torch.from_numpy, (np.stack(projections), frame.rig.ego_from_bev)))


def write_network_image(pixels_bgr: NDArray[np.uint8], image: ImageConfig, out: NDArray[np.float32]) -> None:
    """Resize, crop and normalise an image and write it to the top left corner of `out`; the rest is left unchanged.

    The image is resized as float32, which equals the original's order (normalise, then resize) up to rounding.

    pixels_bgr: (H, W, 3) uint8. out: (3, H', W') float32.
    """
    height, width = pixels_bgr.shape[:2]
    scale = min(image.size[0] / width, image.size[1] / height)
    # "area" averages, which is only defined for shrinking; enlarged images are always interpolated.
    method: Literal["linear", "area"] = "area" if image.resize == "area" and scale < 1 else "linear"
    left, top, right, bottom = image.crop_box
    resize_and_normalize(
        pixels_bgr,
        pixel_weights(height, round(height * scale), method, top, bottom),
        pixel_weights(width, round(width * scale), method, left, right),
        np.asarray(image.mean, dtype=np.float32),
        np.asarray(image.std, dtype=np.float32),
        out,
        reverse_channels=image.color_order == "rgb",
    )


def image_from_bev(frame: Frame, camera_name: str) -> Array:
    """(4, 4) float64 from the bev frame at the frame's time to the undistorted image at the camera's time.

    A point (x, y, z, 1) in metres becomes (u d, v d, d, 1) with pixel (u, v) and depth d in metres.
    """
    camera = frame.rig[camera_name]
    camera_ego_from_world = inverse(frame.world_from_ego_at[camera_name].matrix)
    ego_from_ego = camera_ego_from_world @ frame.world_from_ego.matrix
    return camera.image_from_camera @ camera.camera_from_ego @ ego_from_ego @ frame.rig.ego_from_bev


SMALLEST_OVERLAP = 1e-3  # pixels; OpenCV leaves out what overlaps less with the area of a pixel


@dataclass(frozen=True)
class PixelWeights:
    """The pixels of a row (or column) that each of the n pixels of the resized one is a weighted mean of."""

    first: NDArray[np.int64]  # (n,) int64, index of the first of its K pixels
    weights: NDArray[np.float32]  # (K, n) float32, those of its K pixels


@lru_cache(maxsize=64)
def pixel_weights(
    length: int, new_length: int, method: Literal["linear", "area"], start: int = 0, stop: int | None = None
) -> PixelWeights:
    """The weights that resize a row of `length` pixels to `new_length`, as OpenCV's INTER_LINEAR or INTER_AREA.

    start, stop: the pixels of the resized row that are computed.
    """
    scale, index = length / new_length, np.arange(new_length)[:, None]
    center = np.clip((index + 0.5) * scale - 0.5, 0, length - 1)

    def weigh(pixels: NDArray[np.int64]) -> Array:
        if method == "linear":
            return np.clip(1 - np.abs(pixels - center), 0, None)
        overlap = np.minimum(pixels + 1, (index + 1) * scale) - np.maximum(pixels, index * scale)
        return np.where(overlap > SMALLEST_OVERLAP, overlap / scale, 0)

    reach = int(np.ceil(scale / 2)) + 1
    near = np.floor(center).astype(np.int64) + np.arange(-reach, reach + 1)
    used = (weigh(near) > 0) & (near >= 0) & (near < length)
    first, count = np.take_along_axis(near, used.argmax(1)[:, None], 1), used.sum(1).max()
    first = np.minimum(first, length - count)
    weights = weigh(first + np.arange(count)).astype(np.float32)
    return PixelWeights(first[start:stop, 0], np.ascontiguousarray(weights.T[:, start:stop]))


def resize_and_normalize(
    pixels: NDArray[np.uint8],
    rows: PixelWeights,
    columns: PixelWeights,
    mean: NDArray[np.float32],
    std: NDArray[np.float32],
    out: NDArray[np.float32],
    *,
    reverse_channels: bool,
) -> None:
    """Writes the resized image, less `mean` and divided by `std`, to the top left corner of `out`.

    pixels: (H, W, 3) uint8. rows, columns: of the h rows and w columns of the result. mean, std: (3,) of the result's
    channels. out: (3, h or more, w or more). reverse_channels: whether the first channel becomes the last.
    """
    lines = np.ascontiguousarray(pixels).reshape(len(pixels), -1)
    if reverse_channels:
        mean, std, out = mean[::-1].copy(), std[::-1].copy(), out[::-1]
    _resample(lines, rows.first, rows.weights, columns.first, columns.weights, mean, std, out)


@njit(nogil=True, error_model="numpy", fastmath={"contract"})
def _resample(lines, first_row, row_weights, first_column, column_weights, mean, std, planes) -> None:  # type: ignore[no-untyped-def]
    """lines: (H, W * 3) uint8. planes: (3, h, w) float32, by the channels of `lines`."""
    mixed = np.empty(lines.shape[1], np.float32)  # a row of the result before its columns are resized
    for y in range(len(first_row)):
        mixed[:] = np.float32(0)
        for k in range(len(row_weights)):
            weight = row_weights[k, y]
            if weight > 0:
                line = lines[first_row[y] + k]
                for i in range(len(line)):
                    mixed[i] += weight * np.float32(line[i])
        for x in range(len(first_column)):
            first = second = third = np.float32(0)
            i = 3 * first_column[x]
            for k in range(len(column_weights)):
                weight = column_weights[k, x]
                first += weight * mixed[i]
                second += weight * mixed[i + 1]
                third += weight * mixed[i + 2]
                i += 3
            planes[0, y, x] = (first - mean[0]) / std[0]
            planes[1, y, x] = (second - mean[1]) / std[1]
            planes[2, y, x] = (third - mean[2]) / std[2]


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


def _check_image(pixels: NDArray[Any], camera: Camera) -> None:
    """Raise InputError where pixels are not an image of a camera."""
    shape, dtype = getattr(pixels, "shape", None), getattr(pixels, "dtype", type(pixels).__name__)
    if shape != (camera.height, camera.width, 3) or dtype != np.uint8:
        found = dtype if shape is None else f"{dtype} of shape {shape}"
        raise InputError(
            f"`images`: camera {camera.name}: expected uint8 of shape ({camera.height}, {camera.width}, 3), as in the "
            f"rig (found {found})"
        )


def camera_boxes(found: ImageBoxes, prepared: PreparedFrame, image: ImageConfig) -> dict[str, Boxes2D]:
    """Camera -> the boxes in its image as it was read, for the cameras that have an image.

    Cropping and resizing are undone. Where the image was undistorted for the network, the outline of a box is led
    through the lens, and the box becomes the rectangle around it. A box that is then outside of the image is left out.

    found: of a batch of one, on the CPU. prepared: the frame. image: of the model.
    """
    boxes = {}
    for index, (name, scale) in enumerate(zip(prepared.assignment.cameras, prepared.scales, strict=True)):
        if not prepared.has_image[0, index]:
            continue
        resized = found.boxes[0, index].double().numpy() + np.tile(image.crop_box[:2], 2) + 0.5
        corners, scores = in_image(resized / scale - 0.5, prepared.frame.rig[name]), found.scores[0, index].numpy()
        chosen = (scores >= LEAST_SCORE) & (corners[:, 2:] > corners[:, :2]).all(1)  # False for NaN
        classes = np.array(IMAGE_CLASSES)[found.labels[0, index].numpy()]
        boxes[name] = Boxes2D(corners[chosen], classes[chosen], scores[chosen].astype(np.float64))
    return boxes


def in_image(corners: Array, camera: Camera) -> Array:
    """Boxes (N, 4) of the undistorted image -> those in the camera's image, clipped to it; NaN behind the lens."""
    if camera.distortion is not None:
        share = np.linspace(0, 1, POINTS_OF_SIDE)
        ends = np.stack([np.zeros_like(share), np.ones_like(share)])
        x = np.concatenate([share, share, *ends])[:, None] * (corners[:, 2] - corners[:, 0]) + corners[:, 0]
        y = np.concatenate([*ends, share, share])[:, None] * (corners[:, 3] - corners[:, 1]) + corners[:, 1]
        outline = camera.distorted(np.stack([x, y], -1))  # (points, N, 2)
        with warnings.catch_warnings(action="ignore"):  # of boxes with NaN only
            corners = np.concatenate([np.nanmin(outline, 0), np.nanmax(outline, 0)], -1)
    return np.clip(corners, -0.5, np.tile((camera.width, camera.height), 2) - 0.5)
