"""Augmentation of a clip's images and calibration; boxes and maps stay as they are.

Of the images as read: exposure, noise, missing images, corruptions and, last, photometric distortion. A GPU that trains
distorts the images that enter the network instead. Of those: grid mask and, on the device that trains, randomisation,
so that a model trained on renderings learns shapes and not textures. Each image of each camera then gets its own draw
of random convolution (Xu et al. 2021, "Robust and generalizable visual representation learning via random
convolutions"), contrast, colour, saturation, blur and noise.
"""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from bevcli.frame import CameraImage, Frame
from bevcli.geometry.cameras import CameraRig, camera_pose_noise
from bevcli.geometry.transforms import Array, rigid
from bevcli.model.config import ImageConfig
from bevcli.model.upload import upload
from bevcli.parsing.documents import NotNegative, Share, ShareBelowOne
from bevcli.workshop.synth import corruptions
from bevcli.workshop.synth.corruptions import ImageCorruption

MAX_BRIGHTNESS = 32.0  # added to pixel values of 0 to 255
DISTORTION_RANGE = (0.5, 1.5)  # factors of contrast and saturation
MAX_HUE_DEG = 18.0


@dataclass(frozen=True)
class RandomisationConfig:
    """The [training.augmentation.randomisation] table: probabilities of each change of an image."""

    convolution: Share = 0.0  # a random convolution, 1, 3, 5 or 7 pixels wide, mixed with the image by a random share
    contrast: Share = 0.0  # contrast and brightness
    color: Share = 0.0  # a gain of each channel
    saturation: Share = 0.0  # from an image without colour to stronger colours
    blur: Share = 0.0  # the mean of 3 x 3 pixels
    noise: Share = 0.0  # independent noise of each pixel and channel


@dataclass(frozen=True)
class AugmentationConfig:
    """The [training.augmentation] table."""

    photometric: Share = 0.5  # probability of each distortion of an image: brightness, contrast, saturation, hue
    grid_mask: Share = 0.7  # probability that a grid of grey squares covers an image
    exposure: NotNegative = 0.0  # largest change of a camera's exposure, in stops (factors of 2); constant over a clip
    white_balance: ShareBelowOne = 0.0  # largest relative change of a camera's red and blue; constant over a clip
    # largest standard deviation of the noise, of pixel values 0 to 255. Half of the clips have noise
    noise: NotNegative = 0.0
    drop_image: Share = 0.0  # probability that an image is missing. A frame keeps at least one image
    calibration_share: Share = 0.0  # probability that a clip has noise on the poses of its cameras, constant over it
    calibration_noise: NotNegative = 4.0  # largest level of that noise (`camera_pose_noise`), drawn uniformly from 0
    tilted_share: Share = 0.0  # probability that the vehicle of a clip pitches and rolls, which its poses do not state
    # largest standard deviation of that pitch, drawn uniformly from 0; of the roll half as much. Half of its variance
    # is of the whole clip, as on a slope; each frame draws the rest anew
    tilt_deg: NotNegative = 1.5
    corrupted_share: Share = 0.0  # probability that all images of a clip are corrupted (TRAINED_CORRUPTIONS)
    lost_cameras_share: Share = 0.0  # probability that up to MOST_LOST_CAMERAS cameras deliver nothing, or black images
    randomisation: RandomisationConfig = field(default_factory=RandomisationConfig)  # of network images


ColorChange = tuple[float, float, float, float]  # added brightness, factors of contrast and saturation, change of hue


def augmented(
    clip: list[Frame], config: AugmentationConfig, random: np.random.Generator
) -> tuple[list[Frame], list[dict[str, ColorChange]]]:
    """Copies of the frames of a clip with all changes of images as read but the last, and the draws of the last.

    The last is the photometric distortion of each image, by camera: `distorted` applies it, or `distorted_images` on a
    GPU.
    """
    vary_images, vary_rig = ImageVariation(config, random), CalibrationVariation(config, random)
    tilt = BodyVariation(config, random)
    worsen, frames, distortions = BadConditions(config, random), [], []
    for frame in clip:
        frames.append(tilt(vary_rig(worsen(vary_images(frame)))))
        names = frames[-1].images if config.photometric else ()
        distortions.append({name: draw_color_change(config.photometric, random) for name in names})
    return frames, distortions


class ImageVariation:
    """Exposure, white balance and noise of the cameras of one clip, drawn once; missing images."""

    def __init__(self, config: AugmentationConfig, random: np.random.Generator) -> None:
        self._config, self._random = config, random
        self._tables = defaultdict[str, NDArray[np.uint8]](self._table)  # by camera
        stops = random.uniform(-1, 1) * config.exposure if config.exposure else 0.0
        self._clip_stops = stops / 2  # half of the change is common to all cameras
        self._noise = max(0.0, random.uniform(-1, 1)) * config.noise if config.noise else 0.0

    def __call__(self, frame: Frame) -> Frame:
        """A copy of the frame with its images changed and some of them left out."""
        config, names = self._config, list(frame.images)
        if config.drop_image:
            names = [name for name in names if self._random.random() >= config.drop_image] or names[:1]
        if not (config.exposure or config.white_balance or self._noise) and len(names) == len(frame.images):
            return frame
        return replace(frame, images={name: self._changed(name, frame.images[name]) for name in names})

    def _changed(self, name: str, image: CameraImage) -> CameraImage:
        pixels = np.asarray(cv2.LUT(image.pixels_bgr, self._tables[name]), dtype=np.uint8)
        if self._noise:
            pixels = noisy(pixels, self._noise, self._random)
        return replace(image, pixels_bgr=pixels)

    def _table(self) -> NDArray[np.uint8]:
        """(1, 256, 3) the new value of each pixel value of a channel, of one camera."""
        stops = self._clip_stops + self._random.uniform(-0.5, 0.5) * self._config.exposure
        blue, red = 1 + self._random.uniform(-1, 1, 2) * self._config.white_balance
        gains = np.array([blue, 1.0, red]) * 2.0**stops
        return (np.arange(256)[None, :, None] * gains).clip(0, 255).round().astype(np.uint8)


def noisy(pixels_bgr: NDArray[np.uint8], deviation: float, random: np.random.Generator) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 with normal noise of a standard deviation in grey levels, independent in each pixel and channel.

    OpenCV makes it, in a fraction of the time of `random.standard_normal`; its generator is that of the thread.
    """
    cv2.setRNGSeed(int(random.integers(2**31)))
    noise = np.empty(pixels_bgr.shape, np.int16)
    cv2.randn(noise, np.zeros(3), np.full(3, deviation))
    return np.asarray(cv2.add(pixels_bgr, noise, dtype=cv2.CV_8U), np.uint8)


# Corruptions to train on, and their levels. The others of `bevcli.workshop.synth.corruptions` are kept for scores.
TRAINED_CORRUPTIONS: tuple[tuple[ImageCorruption, tuple[int, ...]], ...] = (
    (corruptions.low_light, tuple(corruptions.LOW_LIGHT)),
    (corruptions.fog, tuple(corruptions.FOG)),
    (corruptions.snow, tuple(corruptions.SNOW)),
    (corruptions.brightness, tuple(corruptions.BRIGHTNESS)),
    (corruptions.motion_blur, tuple(corruptions.MOTION_BLUR)),
    (corruptions.color_quantisation, (1, 2, 3)),
)
MOST_LOST_CAMERAS = 4


class BadConditions:
    """A corruption of all images of one clip, and cameras that deliver nothing, both drawn once."""

    def __init__(self, config: AugmentationConfig, random: np.random.Generator) -> None:
        self._random, self._lost, self._black = random, 0, False
        self._corruption: tuple[ImageCorruption, int] | None = None
        if random.random() < config.corrupted_share:
            corrupt, levels = TRAINED_CORRUPTIONS[random.integers(len(TRAINED_CORRUPTIONS))]
            self._corruption = corrupt, int(random.choice(levels))
        if random.random() < config.lost_cameras_share:
            self._lost, self._black = int(random.integers(1, MOST_LOST_CAMERAS + 1)), bool(random.random() < 0.5)
        self._order: dict[str, int] = {}  # camera -> its rank among those that are lost one after the other

    def __call__(self, frame: Frame) -> Frame:
        """A copy of the frame with its images corrupted, and some of them left out or black."""
        if self._corruption is None and not self._lost:
            return frame
        if not self._order:
            ranks = self._random.permutation(len(frame.rig.names))
            self._order = dict(zip(frame.rig.names, map(int, ranks), strict=True))
        lost = min(self._lost, len(self._order) - 1)
        images = {}
        for name, image in frame.images.items():
            if self._order[name] >= lost:
                pixels = image.pixels_bgr
                if self._corruption is not None:
                    corrupt, level = self._corruption
                    pixels = corrupt(pixels, level, self._random)
                images[name] = replace(image, pixels_bgr=pixels)
            elif self._black:
                images[name] = replace(image, pixels_bgr=np.zeros_like(image.pixels_bgr))
        return replace(frame, images=images)


class CalibrationVariation:
    """Noise on the poses of the cameras of one clip, drawn once."""

    def __init__(self, config: AugmentationConfig, random: np.random.Generator) -> None:
        noisy = config.calibration_share > 0 and random.random() < config.calibration_share
        self._level = random.uniform(0, config.calibration_noise) if noisy else 0.0
        self._noise = defaultdict[str, Array](lambda: camera_pose_noise(self._level, random))  # by camera
        self._noisy: tuple[CameraRig, CameraRig] | None = None  # a rig as it was read, and with noise

    def __call__(self, frame: Frame) -> Frame:
        """A copy of the frame whose cameras state wrong poses, or the frame itself. Frames share their noisy rig."""
        if not self._level:
            return frame
        if self._noisy is None or self._noisy[0] is not frame.rig:
            cameras = tuple(
                replace(camera, ego_from_camera=camera.ego_from_camera @ self._noise[camera.name])
                for camera in frame.rig.cameras
            )
            self._noisy = (frame.rig, replace(frame.rig, cameras=cameras))
        return replace(frame, rig=self._noisy[1])


class BodyVariation:
    """Pitch and roll of the vehicle of one clip that its poses do not state.

    The images stay; the cameras state the poses that they would have on a level vehicle which is tilted the other way.
    """

    def __init__(self, config: AugmentationConfig, random: np.random.Generator) -> None:
        tilted = config.tilted_share > 0 and random.random() < config.tilted_share
        deviation_deg = random.uniform(0, config.tilt_deg) if tilted else 0.0
        self._deviation = np.radians(deviation_deg) * np.array([0.5, 1.0, 0.0]) / np.sqrt(2)  # about x, y, z
        self._random, self._of_clip = random, self._deviation * random.standard_normal(3)

    def __call__(self, frame: Frame) -> Frame:
        """A copy of the frame whose cameras are tilted together, or the frame itself."""
        if not self._deviation.any():
            return frame
        rotation, _ = cv2.Rodrigues(self._of_clip + self._deviation * self._random.standard_normal(3))
        ego_from_tilted = rigid(np.zeros(3), rotation)
        cameras = (replace(x, ego_from_camera=ego_from_tilted @ x.ego_from_camera) for x in frame.rig.cameras)
        return replace(frame, rig=replace(frame.rig, cameras=tuple(cameras)))


UNDISTORTED: ColorChange = (0.0, 1.0, 1.0, 0.0)


def draw_color_change(probability: float, random: np.random.Generator) -> ColorChange:
    """Brightness, contrast, saturation and hue (degrees) of an image, each changed with the given probability."""
    applied = random.random(4) < probability
    drawn = [random.uniform(-MAX_BRIGHTNESS, MAX_BRIGHTNESS), *random.uniform(*DISTORTION_RANGE, 2)]
    drawn.append(random.uniform(-MAX_HUE_DEG, MAX_HUE_DEG))
    brightness, contrast, saturation, hue_deg = np.where(applied, drawn, UNDISTORTED).tolist()
    return brightness, contrast, saturation, hue_deg


def distorted(frame: Frame, distortions: Mapping[str, ColorChange]) -> Frame:
    """A copy of the frame with the images of some cameras distorted."""
    changed = {
        name: replace(frame.images[name], pixels_bgr=distort(frame.images[name].pixels_bgr, distortion))
        for name, distortion in distortions.items()
    }
    return replace(frame, images={**frame.images, **changed}) if changed else frame


def distort(pixels_bgr: NDArray[np.uint8], distortion: ColorChange) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 with brightness, contrast, saturation and hue changed."""
    brightness, contrast, saturation, hue_deg = distortion
    pixels = (pixels_bgr.astype(np.float32) + np.float32(brightness)) * np.float32(contrast)
    if (saturation, hue_deg) != UNDISTORTED[2:]:
        hsv = cv2.cvtColor(pixels.clip(0, 255) / np.float32(255), cv2.COLOR_BGR2HSV)
        hsv[..., 0] = (hsv[..., 0] + hue_deg) % 360
        hsv[..., 1] = (hsv[..., 1] * saturation).clip(0, 1)
        pixels = cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR) * np.float32(255)
    return pixels.clip(0, 255).astype(np.uint8)


def distorted_images(pixels: Tensor, distortions: Tensor, color_order: str) -> Tensor:
    """As `distort`, but on any device and without rounding: up to one level brighter.

    pixels: (M, 3, H, W) float32, 0 to 255, in that order of the colours. distortions: (M, 4).
    """
    brightness, contrast, saturation, hue_deg = distortions[:, :, None, None].split(1, dim=1)  # (M, 1, 1, 1) each
    pixels = ((pixels + brightness) * contrast).clamp(0, 255)
    red, green, blue = pixels.unbind(1) if color_order == "rgb" else pixels.flip(1).unbind(1)
    value, chroma = pixels.amax(1), pixels.amax(1) - pixels.amin(1)  # (M, H, W)
    third = torch.where(value == green, 2 + (blue - red) / chroma, 4 + (red - green) / chroma)
    sixths = torch.where(value == red, (green - blue) / chroma, third).where(chroma > 0, 0)[:, None]  # the hue in 60°
    chroma = (chroma / value.clamp(min=1e-6))[:, None].mul(saturation).clamp(0, 1) * value[:, None]
    # Each channel is the value less a share of the chroma, which depends on its distance from the hue.
    starts = torch.arange(5, 0, -2, device=pixels.device).view(3, 1, 1)
    starts = starts if color_order == "rgb" else starts.flip(0)
    distance = (starts + sixths + hue_deg / 60) % 6  # (M, 3, H, W)
    return value[:, None] - chroma * torch.minimum(distance, 4 - distance).clamp(0, 1)


def mask_images(images: Tensor, probability: float, random: np.random.Generator) -> None:
    """Covers normalised images (..., 3, H, W) with a grid of grey squares in place, each with the given probability."""
    for image in images.flatten(0, -4):
        if random.random() < probability:
            height, width = image.shape[-2:]
            period = int(random.integers(2, max(3, min(height, width))))
            # True in the first half of each period, with a random phase.
            rows, columns = (
                (np.arange(extent) + random.integers(period)) % period < period / 2 for extent in (height, width)
            )
            image.masked_fill_(torch.from_numpy(rows[:, None] & columns), 0)


KERNEL_SIZES = (1, 3, 5, 7)
CONTRAST_RANGE = (0.6, 1.5)  # factors of the differences to grey
BRIGHTNESS_RANGE = (-51.0, 51.0)  # added to pixel values of 0 to 255
COLOR_RANGE = (0.7, 1.3)  # factors of each channel
SATURATION_RANGE = (0.0, 1.6)  # factors of the differences to an image without colour
NOISE_RANGE = (0.0, 19.0)  # standard deviations, of pixel values of 0 to 255
GREY = 127.0


def randomised(images: Tensor, config: RandomisationConfig, image: ImageConfig, generator: torch.Generator) -> Tensor:
    """A copy of images, each with its own changes. Padding, and images that are missing, stay zero.

    Args:
        images: (..., 3, H, W) float32, normalised and padded, on any device.
        config: the probabilities.
        image: the normalisation of the images.
        generator: on the CPU; everything but the noise itself is drawn there, so that no draw waits for a GPU.
    """
    if not any(vars(config).values()):
        return images
    x = images.flatten(0, -4)  # (M, 3, H, W)
    y = _recolored(_convolved(x, config, generator), config, image, generator)
    blurred = upload(_random_indices(len(y), config.blur, generator), y.device)
    y = y.index_copy(0, blurred, F.avg_pool2d(y[blurred], 3, 1, padding=1, count_include_pad=False))
    y = _noisy(y, config, image, generator)
    return (y * _inside(x)).view_as(images)


def renormalised(images: Tensor, image: ImageConfig, other: ImageConfig) -> Tensor:
    """Images (..., 3, H, W), normalised as one model takes them, as another model takes them. Padding stays zero."""
    x = images.flatten(0, -4)
    std, mean, other_std, other_mean = (
        upload(torch.tensor(values)[:, None, None], x.device)
        for values in (image.std, image.mean, other.std, other.mean)
    )
    y = x * std + mean
    y = y if image.color_order == other.color_order else y.flip(1)
    return ((y - other_mean) / other_std * _inside(x)).view_as(images)


def _inside(x: Tensor) -> Tensor:
    """(M, 1, H, W) bool: the rows and columns of images (M, 3, H, W) that are no padding; none where one is missing."""
    shown = x.ne(0)
    return shown.any(dim=3, keepdim=True).any(1, keepdim=True) & shown.any(dim=2, keepdim=True).any(1, keepdim=True)


def _convolved(x: Tensor, config: RandomisationConfig, generator: torch.Generator) -> Tensor:
    """(M, 3, H, W) of which some are mixed with a random convolution that keeps their contrast."""
    selected = _random_indices(len(x), config.convolution, generator)
    sizes = torch.randint(len(KERNEL_SIZES), (len(selected),), generator=generator)
    shares = torch.rand(len(selected), 1, 1, 1, generator=generator)
    y = x.clone()
    for index_of_size, size in enumerate(KERNEL_SIZES):
        of_size = (sizes == index_of_size).nonzero()[:, 0]
        count = len(of_size)
        if not count:
            continue
        weights = torch.randn(3 * count, 3, size, size, generator=generator)
        index, share = upload(selected[of_size], x.device), upload(shares[of_size], x.device)
        images = x[index]
        z = F.conv2d(images.flatten(0, 1)[None], upload(weights, x.device), padding=size // 2, groups=count)
        z = z.view_as(images)
        contrast = (images.std(dim=(1, 2, 3)) + 1e-3) / (z.std(dim=(1, 2, 3)) + 1e-3)
        y[index] = torch.lerp(z * contrast[:, None, None, None], images, share)
    return y


def _recolored(x: Tensor, config: RandomisationConfig, image: ImageConfig, generator: torch.Generator) -> Tensor:
    """(M, 3, H, W) with contrast, brightness, colour and saturation changed: one matrix and one offset an image."""
    count = len(x)

    def draw(share: float, channels: int, low: float, high: float, unchanged: float) -> Tensor:
        drawn = low + (high - low) * torch.rand(count, channels, 1, generator=generator)
        return drawn.where(torch.rand(count, 1, 1, generator=generator) < share, unchanged)

    contrast, brightness = draw(1.0, 1, *CONTRAST_RANGE, 1.0), draw(1.0, 1, *BRIGHTNESS_RANGE, 0.0)
    changed = torch.rand(count, 1, 1, generator=generator) < config.contrast
    contrast, brightness = contrast.where(changed, 1.0), brightness.where(changed, 0.0)
    colors = draw(config.color, 3, *COLOR_RANGE, 1.0)
    saturation = draw(config.saturation, 1, *SATURATION_RANGE, 1.0)
    mixing = saturation * torch.eye(3) + (1 - saturation) / 3  # (M, 3, 3)
    # On pixel values p minus GREY: mixing @ (colors * (contrast * p + brightness)), and p = std * x + mean - GREY.
    std, mean = (torch.tensor(values, dtype=torch.float32)[:, None] for values in (image.std, image.mean))
    matrix = mixing * (colors * contrast).transpose(1, 2)
    offset = matrix @ (mean - GREY) + mixing @ (colors * brightness) - (mean - GREY)
    matrix, offset = matrix * std.T / std, offset / std
    return torch.baddbmm(upload(offset, x.device), upload(matrix, x.device), x.flatten(2)).view_as(x)


def _noisy(x: Tensor, config: RandomisationConfig, image: ImageConfig, generator: torch.Generator) -> Tensor:
    selected = _random_indices(len(x), config.noise, generator)
    low, high = NOISE_RANGE
    deviation = low + (high - low) * torch.rand(len(selected), 1, 1, 1, generator=generator)
    deviation = deviation / torch.tensor(image.std)[:, None, None]  # (K, 3, 1, 1)
    seed = int(torch.randint(2**62, (), generator=generator))
    of_device = torch.Generator(x.device).manual_seed(seed)
    noise = torch.randn(len(selected), *x.shape[1:], generator=of_device, device=x.device)
    return x.index_add(0, upload(selected, x.device), noise * upload(deviation, x.device))


def _random_indices(count: int, share: float, generator: torch.Generator) -> Tensor:
    """Indices of images, each chosen with a probability."""
    return (torch.rand(count, generator=generator) < share).nonzero()[:, 0]
