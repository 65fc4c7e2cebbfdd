"""From a frame to the network's input. Images are resized only here, together with their calibration."""

from __future__ import annotations

import os
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bevcli.frame import Frame
from bevcli.geometry.cameras import Camera, CameraRig, level_rig
from bevcli.geometry.transforms import Array, inverse
from bevcli.model.bevformer import BEVFormerConfig, ImageConfig
from bevcli.pipeline.camera_assignment import CameraAssignment, assign_cameras
from bevcli.pipeline.resize import resize_and_normalize, resize_taps


@dataclass(frozen=True)
class PreparedFrame:
    """A frame and the network's input made of it, for N cameras.

    Attributes:
        frame: the frame as it was read, but for the bev frame of its rig: see `BevFrameConfig.level`.
        assignment: the N cameras and the model cameras whose embeddings they use.
        scales: (N,) pixels of the resized image per pixel of the camera's image.
        images: (1, N, 3, H, W) float32, normalised; zero where an image is missing. Uploaded ahead to a CUDA GPU.
        image_from_bev: (1, N, 4, 4) float64, to network pixels.
        camera_index: (N,) int64, index of each camera's embedding.
        has_image: (1, N) bool.
    """

    frame: Frame
    assignment: CameraAssignment
    scales: tuple[float, ...]
    images: Tensor
    image_from_bev: Tensor
    camera_index: Tensor
    has_image: Tensor


class Preprocessor:
    """Prepares the frames of a sequence for one model.

    chosen_cameras: camera -> model camera whose embedding it uses. Other cameras are assigned by viewing direction.
    """

    def __init__(self, config: BEVFormerConfig, chosen_cameras: Mapping[str, str] | None = None) -> None:
        self.config = config
        self._chosen_cameras = chosen_cameras
        self._rig: CameraRig | None = None
        self._model_rig: CameraRig
        self._assignment = CameraAssignment((), ())
        self._image = config.image

    def __call__(self, frame: Frame) -> PreparedFrame:
        """The frame with its images undistorted, resized, normalised and padded, and the matching projections."""
        self._use_rig(frame.rig)
        frame = frame if frame.rig is self._model_rig else replace(frame, rig=self._model_rig)
        image, names = self._image, self._assignment.cameras
        width, height = image.padded_size
        images = torch.zeros(1, len(names), 3, height, width)

        def write(place: int, name: str) -> None:
            pixels = frame.rig[name].undistort(frame.images[name].pixels_bgr)
            write_network_image(pixels, image, out=images[0, place].numpy())

        # In parallel: in sequence, preparing the images takes longer than the model on a GPU.
        with ThreadPoolExecutor(min(len(names), os.cpu_count() or 1)) as threads:
            tasks = [threads.submit(write, i, name) for i, name in enumerate(names) if name in frame.images]
        for task in tasks:
            task.result()  # it is done: the pool has waited for it
        scales = tuple(network_scale(frame.rig[name], image) for name in names)
        matrices = [image_from_bev(frame, name) for name in names]
        networks = [network_from_image(frame.rig[name], image) for name in names]
        projections = [network @ matrix for network, matrix in zip(networks, matrices, strict=True)]
        return PreparedFrame(
            frame=frame,
            assignment=self._assignment,
            scales=scales,
            images=images,
            image_from_bev=torch.from_numpy(np.stack(projections))[None],
            camera_index=torch.tensor([self.config.cameras.index(name) for name in self._assignment.embeddings]),
            has_image=torch.tensor([[name in frame.images for name in names]]),
        )

    def _use_rig(self, rig: CameraRig) -> None:
        if rig is self._rig:
            return
        self._rig, bev_frame = rig, self.config.bev_frame
        self._model_rig = level_rig(rig, bev_frame.height_m) if bev_frame.level else rig
        self._assignment = assign_cameras(rig, self.config.cameras, self._chosen_cameras)
        self._image = image_for_rig(rig, self.config.image)


def image_for_rig(rig: CameraRig, image: ImageConfig) -> ImageConfig:
    """How the images of a rig become the network's input: in a size of its own where the model has a `focal_px`.

    The size is then the smallest that holds all resized images. They fit inside `image.size`, or are larger by one
    factor for all cameras, at most up to `focal_px` and `max_pixels`.
    """
    if image.focal_px is None or image.max_pixels is None or not rig.cameras:
        return image
    enlargement = rig_enlargement(rig, image)
    return replace(image, size=_common_size(rig, image, enlargement), focal_px=None, max_pixels=None)


def rig_enlargement(rig: CameraRig, image: ImageConfig) -> float:
    """How many times larger than inside `image.size` the images of a rig are, at least 1: see `image_for_rig`."""
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
    left, top = image.crop_box[:2]
    matrix = np.diag([scale, scale, 1.0, 1.0])
    shift = resize_shift(scale, image)
    matrix[:2, 2] = shift - left, shift - top
    return matrix


def resize_shift(scale: float, image: ImageConfig) -> float:
    """Pixels of the resized image that are added to scaled pixel coordinates: see `ImageConfig.half_pixel_shift`."""
    return (scale - 1) / 2 if image.half_pixel_shift else 0.0


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
        resize_taps(height, round(height * scale), method)[top:bottom],
        resize_taps(width, round(width * scale), method)[left:right],
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
