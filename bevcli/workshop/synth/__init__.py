"""The rendered world: drives through a procedural city, with images from any rig and exact ground truth.

meshes     `mesh` (primitives), `road_users`, `catalog` (what stands still; all annotated objects by class)
world      `city` (streets, blocks, routes), `scenery` and its looks, `ground`, `traffic`, `simulation` (all actors)
images     `rig` (cameras and lenses), `shading_kernels`, `material` (a user's photographs), `renderer`
drives     `drive` (one drive; `render`), `drives` (of a training, a validation, a stress test)

Each module imports only from those before it.
"""

import re
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from bevcli.errors import InputError
from bevcli.options import option, options
from bevcli.sequences.options import ClassOptions

if TYPE_CHECKING:
    from bevcli.geometry.cameras import CameraRig
else:  # the command line reads the types, and must not import OpenCV
    CameraRig = Path


Weather = Literal["noon", "evening", "overcast"]
Body = Literal["still", "moving", "unstated"]
JPEG_QUALITY = 90
LIMITS = (16, 8192)  # of width and height of rendered images, pixels


def parse_resolution(text: str) -> tuple[int, int]:
    """Width and height from a text such as "800x450". Raises ValueError."""
    match = re.fullmatch(r"(\d+)[x×](\d+)", text.strip())
    if match is None or not all(LIMITS[0] <= int(number) <= LIMITS[1] for number in match.groups()):
        raise ValueError(f"expected WxH with numbers from {LIMITS[0]} to {LIMITS[1]}, such as 800x450, found {text!r}")
    return int(match[1]), int(match[2])


def parse_seeds(text: str) -> tuple[int, ...]:
    """Seeds from "A:B" (B excluded) or "A,B,C". Raises InputError."""
    try:
        start, colon, end = text.partition(":")
        seeds = tuple(range(int(start), int(end)) if colon else map(int, text.split(",")))
    except ValueError:
        seeds = ()
    if not seeds or min(seeds) < 0:
        raise InputError(
            f'`rendered` (`--rendered`) "{text}": expected seeds as A:B (B excluded) or A,B,C, none of them negative'
        )
    return seeds


@options()
class RenderOptions:
    """The options of a rendered drive. Raises InputError for a value out of range."""

    seed: int = option(default=0, help="Seed of the drive. The same seed gives the same files.", minimum=0)
    frames: int = option(default=20, help="Number of frames.", metavar="N", flag="--count", minimum=1)
    rig: str | Path | CameraRig | None = option(
        reads="path",
        default=None,
        help="The cameras, a calibration.json. Default: six cameras like nuScenes.",
        metavar="FILE",
    )
    rate_hz: float = option(
        default=2.0, help="Frames per second.", flag="--rate", metavar="HZ", minimum=0.1, maximum=100
    )
    resolution: tuple[int, int] | None = option(
        default=None,
        help="Size of the images in pixels, such as 800x450. Default: that of the rig.",
        metavar="WxH",
        parse=parse_resolution,
        minimum=LIMITS[0],
        maximum=LIMITS[1],
    )
    weather: Weather | None = option(default=None, help="Light and sky. Default: drawn from the seed.")
    body: Body = option(
        default="still",
        help="The vehicle's body: still, moving (it pitches and rolls, as the poses state), or moving unstated (the "
        "poses are level).",
    )
    quality: int = option(default=JPEG_QUALITY, help="JPEG quality.", minimum=1, maximum=100)
    supersampling: int | None = option(
        default=None,
        help="Supersampling factor per axis (anti-aliasing). Default: 2 up to 1000 pixels wide, else 1.",
        minimum=1,
        maximum=4,
    )
    force: bool = option(default=False, help="Replace a sequence in OUT.")


@options()
class DemoOptions:
    """The drive of `bevcli demo`."""

    out: Path = option(default=Path("runs/demo"), help="Folder for the drive and the results.")
    seed: int = option(
        default=1_000_001, help="Seed of the drive. The model was trained on seeds below 1000000 only.", minimum=0
    )
    frames: int = option(default=8, help="Number of frames, two per second.", metavar="N", flag="--count", minimum=1)
    view: bool = option(default=True, help="Open the viewer at the end.", flag="--view/--no-view")
    force: bool = option(default=False, help="Replace an earlier demo in OUT.")


@options()
class DriveOptions(ClassOptions):
    """Drives with ground truth: sequences, or rendered ones."""

    data: tuple[Path, ...] = option(
        reads="path",
        default=(),
        help="A sequence with ground truth (see bevcli convert). Repeatable.",
        metavar="DIR",
        repeatable=True,
    )
    rendered: tuple[int, ...] | None = option(
        default=None,
        help="Use rendered drives with these seeds instead: A:B (B excluded), or A,B,C.",
        metavar="SEEDS",
        parse=parse_seeds,
    )
    split: Path | None = option(
        reads="path",
        default=None,
        help="Use the drives of a TOML file with two lists of folders instead: train and validate.",
        metavar="FILE.toml",
    )
    cache: Path = option(default=Path("runs/drives"), help="Folder that keeps rendered drives.", metavar="DIR")
