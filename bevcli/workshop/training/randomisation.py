"""Randomisation of training images, so that a model trained on renderings learns shapes and not their textures.

Each image of each camera gets its own draw of random convolution (Xu et al. 2021, "Robust and generalizable visual
representation learning via random convolutions"), contrast, colour, saturation, blur and noise. The images are those
that enter the network, on its device; all of a batch are changed at once.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from bevcli.model.config import ImageConfig
from bevcli.model.step import ModelInputs
from bevcli.model.upload import upload

KERNEL_SIZES = (1, 3, 5, 7)
CONTRAST_RANGE = (0.6, 1.5)  # factors of the differences to grey
BRIGHTNESS_RANGE = (-51.0, 51.0)  # added to pixel values of 0 to 255
COLOR_RANGE = (0.7, 1.3)  # factors of each channel
SATURATION_RANGE = (0.0, 1.6)  # factors of the differences to an image without colour
NOISE_RANGE = (0.0, 19.0)  # standard deviations, of pixel values of 0 to 255
GREY = 127.0


@dataclass(frozen=True)
class RandomisationConfig:
    """The [training.augmentation.randomisation] table: probabilities (0 to 1) of each change of an image.

    Attributes:
        convolution: a random convolution, 1, 3, 5 or 7 pixels wide, mixed with the image by a random share.
        contrast: contrast and brightness.
        color: a gain of each channel.
        saturation: from an image without colour to stronger colours.
        blur: the mean of 3 x 3 pixels.
        noise: independent noise of each pixel and channel.
    """

    convolution: float = 0.0
    contrast: float = 0.0
    color: float = 0.0
    saturation: float = 0.0
    blur: float = 0.0
    noise: float = 0.0

    def __post_init__(self) -> None:
        wrong = [name for name, share in vars(self).items() if not 0 <= share <= 1]
        if wrong:
            raise ValueError(f"{wrong[0]} is a probability, from 0 to 1")

    @property
    def active(self) -> bool:
        """Some images are changed."""
        return any(vars(self).values())


def randomised(images: Tensor, config: RandomisationConfig, image: ImageConfig, generator: torch.Generator) -> Tensor:
    """A copy of images, each with its own changes. Padding, and images that are missing, stay zero.

    Args:
        images: (..., 3, H, W) float32, normalised and padded, on any device.
        config: the probabilities.
        image: the normalisation of the images.
        generator: on the CPU; everything but the noise itself is drawn there, so that no draw waits for a GPU.
    """
    if not config.active:
        return images
    x = images.flatten(0, -4)  # (M, 3, H, W)
    y = _blurred(_recolored(_convolved(x, config, generator), config, image, generator), config, generator)
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


def randomised_inputs(
    inputs: Iterable[ModelInputs], config: RandomisationConfig, image: ImageConfig, generator: torch.Generator
) -> tuple[ModelInputs, ...]:
    """Copies of the inputs with `randomised` images."""
    return tuple(replace(one, images=randomised(one.images, config, image, generator)) for one in inputs)


def _convolved(x: Tensor, config: RandomisationConfig, generator: torch.Generator) -> Tensor:
    """(M, 3, H, W) of which some are mixed with a random convolution that keeps their contrast."""
    chosen = _chosen(len(x), config.convolution, generator)
    sizes = torch.randint(len(KERNEL_SIZES), (len(chosen),), generator=generator)
    shares = torch.rand(len(chosen), 1, 1, 1, generator=generator)
    y = x.clone()
    for place, size in enumerate(KERNEL_SIZES):
        of_size = (sizes == place).nonzero()[:, 0]
        count = len(of_size)
        if not count:
            continue
        weights = torch.randn(3 * count, 3, size, size, generator=generator)
        index, share = upload(chosen[of_size], x.device), upload(shares[of_size], x.device)
        part = x[index]
        z = F.conv2d(part.flatten(0, 1)[None], upload(weights, x.device), padding=size // 2, groups=count)
        z = z.view_as(part)
        contrast = (part.std(dim=(1, 2, 3)) + 1e-3) / (z.std(dim=(1, 2, 3)) + 1e-3)
        y[index] = torch.lerp(z * contrast[:, None, None, None], part, share)
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


def _blurred(x: Tensor, config: RandomisationConfig, generator: torch.Generator) -> Tensor:
    index = upload(_chosen(len(x), config.blur, generator), x.device)
    return x.index_copy(0, index, F.avg_pool2d(x[index], 3, 1, padding=1, count_include_pad=False))


def _noisy(x: Tensor, config: RandomisationConfig, image: ImageConfig, generator: torch.Generator) -> Tensor:
    chosen = _chosen(len(x), config.noise, generator)
    low, high = NOISE_RANGE
    deviation = low + (high - low) * torch.rand(len(chosen), 1, 1, 1, generator=generator)
    deviation = deviation / torch.tensor(image.std)[:, None, None]  # (K, 3, 1, 1)
    seed = int(torch.randint(2**62, (), generator=generator))
    of_device = torch.Generator(x.device).manual_seed(seed)
    noise = torch.randn(len(chosen), *x.shape[1:], generator=of_device, device=x.device)
    return x.index_add(0, upload(chosen, x.device), noise * upload(deviation, x.device))


def _chosen(count: int, share: float, generator: torch.Generator) -> Tensor:
    """Indices of images, each chosen with a probability."""
    return (torch.rand(count, generator=generator) < share).nonzero()[:, 0]
