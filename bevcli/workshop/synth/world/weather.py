"""Weather: the light of the sun and the sky, the clouds and the haze of one drive."""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.workshop.synth.assets.paint import Color, linear

Range = tuple[float, float]  # lowest and highest value


@dataclass(frozen=True)
class Weather:
    """The light of a drive.

    Attributes:
        name: one of WEATHER_NAMES.
        to_sun: (3,) unit vector towards the sun, world.
        light: (7, 3) linear RGB; 1 is about the brightness of a white surface in full sun. The rows are the light from
            the sun, from above and, reflected by the ground, from below; the colours of the sky overhead and at the
            horizon; the colours of the haze and of the clouds.
        clouds: (512, 512) cloud cover, 0 to 1, on a horizontal plane; it repeats in both directions.
        kind: the numbers of its name.
    """

    name: str
    to_sun: NDArray[np.float64]
    light: NDArray[np.float64]
    clouds: NDArray[np.float32]
    kind: "WeatherKind"


class WeatherKind(NamedTuple):
    """The numbers of one kind of weather. A range is drawn uniformly; a number is taken as it is."""

    elevation: Range | float  # of the sun, radians
    sun: tuple[float, float, float]  # colour of the sunlight, linear RGB
    strength: float  # of the sunlight
    sky: tuple[float, float, float]  # light from above, linear RGB
    zenith: Color
    horizon: Color
    cloud: Color
    cloud_threshold: Range | float  # noise above it is cloud, 0 to 1
    haze_m: float  # distance after which about 63 % of the light comes from the haze, metres
    lamps: float  # brightness of lamps and lit windows, relative
    shadow_softness_m: float  # width of the edge of shadows, metres


_KINDS = {
    "noon": WeatherKind(
        (0.65, 1.05), (1.0, 0.95, 0.86), 1.25, (0.32, 0.39, 0.50),
        (84, 136, 206), (190, 212, 232), (255, 255, 255), (0.45, 0.62), 420.0, 0.5, 0.05,
    ),
    "evening": WeatherKind(
        (0.22, 0.38), (1.0, 0.70, 0.42), 0.95, (0.26, 0.28, 0.38),
        (92, 118, 178), (250, 206, 160), (255, 214, 178), (0.42, 0.6), 300.0, 1.2, 0.12,
    ),
    "overcast": WeatherKind(
        1.35, (0.95, 0.98, 1.0), 0.22, (0.50, 0.53, 0.57),
        (150, 158, 168), (205, 210, 214), (222, 226, 230), 0.2, 230.0, 0.8, 0.8,
    ),
}  # fmt: skip
WEATHER_NAMES = tuple(_KINDS)


def make_weather(name: str, rng: np.random.Generator) -> Weather:
    """The weather of a name, with sun and clouds drawn from `rng`. Raises InputError where the name is not known."""
    if name not in _KINDS:
        raise InputError(f"weather: expected {', '.join(WEATHER_NAMES[:-1])} or {WEATHER_NAMES[-1]}, found {name!r}")
    kind = _KINDS[name]
    azimuth, elevation = rng.uniform(0, 2 * np.pi), _drawn(kind.elevation, rng)
    sun = (np.array(kind.sun) * kind.strength).astype(np.float32)
    sky, horizon = np.array(kind.sky, np.float32), linear(kind.horizon)
    bounce = (0.22 * (sun * np.sin(elevation) + sky) + 0.25 * sky).astype(np.float32)
    haze = horizon * np.float32(0.95)
    return Weather(
        name,
        np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]),
        np.array([sun, sky, bounce, linear(kind.zenith), horizon, haze, linear(kind.cloud)], np.float64),
        _clouds(rng, _drawn(kind.cloud_threshold, rng)),
        kind,
    )


def _drawn(value: Range | float, rng: np.random.Generator) -> float:
    return rng.uniform(*value) if isinstance(value, tuple) else value


def _clouds(rng: np.random.Generator, threshold: float) -> NDArray[np.float32]:
    """(512, 512) cloud cover, 0 to 1, repeating in both directions: five octaves of noise above a threshold."""
    size = 512
    total = np.zeros((size, size))
    for octave in range(5):
        total += tiling_noise(rng, size, 4 * 2**octave) * 0.5**octave
    total = (total - total.min()) / (total.max() - total.min())
    cover = np.clip((total - threshold) / 0.25, 0, 1)
    return (cover * cover * (3 - 2 * cover)).astype(np.float32)


def tiling_noise(rng: np.random.Generator, size: int, cells: int, low: float = 0.0) -> NDArray[np.float64]:
    """(size, size) smooth noise from about low to low + 1 with `cells` waves a side; it repeats in both directions."""
    coarse = np.pad(rng.random((cells, cells)), 2, mode="wrap") + low
    scale = size // cells
    fine = cv2.resize(coarse, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    return np.asarray(fine[2 * scale : 2 * scale + size, 2 * scale : 2 * scale + size])
