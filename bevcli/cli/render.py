"""`bevcli render`: a drive through a rendered city, with exact ground truth, as a native sequence folder."""

from __future__ import annotations

import re
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

SMOOTHED_WIDTH = 1000  # smaller images show jagged edges more, and are quickly drawn


class WeatherChoice(StrEnum):
    """What --weather takes."""

    NOON = "noon"
    EVENING = "evening"
    OVERCAST = "overcast"


def render(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="The native sequence folder to write.")],
    seed: Annotated[int, typer.Option(min=0, help="Which drive: the same seed gives the same files.")] = 0,
    frames: Annotated[int, typer.Option(min=1, help="How many frames.")] = 20,
    rig: Annotated[
        Path | None, typer.Option(metavar="FILE", help="A calibration.json; default: six cameras as nuScenes'.")
    ] = None,
    rate: Annotated[float, typer.Option(metavar="HZ", min=0.1, max=100, help="Frames a second.")] = 2.0,
    resolution: Annotated[
        str | None, typer.Option(metavar="WxH", help="Size of the images, such as 800x450; default: the rig's.")
    ] = None,
    weather: Annotated[WeatherChoice | None, typer.Option(help="Default: drawn from the seed.")] = None,
    quality: Annotated[int, typer.Option(min=1, max=100, help="Of the JPEG images.")] = 90,
    supersampling: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=4,
            help="Samples a pixel and side, against jagged edges; default: 2 up to 1000 pixels wide, else 1.",
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace a sequence in OUT.")] = False,
) -> None:
    """Render a drive through a procedural city as a sequence with ground truth boxes and maps."""
    from bevcli.cli.progress import Progress
    from bevcli.synth.drive import Drive
    from bevcli.synth.export import export_drive
    from bevcli.synth.rig import rig_for_rendering

    size = parse_resolution(resolution)
    cameras = rig_for_rendering(rig, size)
    chosen = None if weather is None else weather.value
    width = max(camera.width for camera in cameras.cameras)
    samples = supersampling or (2 if width <= SMOOTHED_WIDTH else 1)
    typer.echo("note: the first rendering on a computer compiles the renderer, about 15 s", err=True)
    drive = Drive(seed, frames, rate, cameras, chosen, supersampling=samples, threads=2)
    with Progress(frames, "frames") as progress:
        export_drive(drive, out, force=force, quality=quality, progress=lambda frame: progress.advance())
    typer.echo(f"{out}: {frames} frames, {len(cameras.cameras)} cameras, {drive.weather.name}, seed {seed}")


def parse_resolution(text: str | None) -> tuple[int, int] | None:
    """ "800x450" as (800, 450). Raises typer.BadParameter for anything else."""
    if text is None:
        return None
    match = re.fullmatch(r"(\d+)[x×](\d+)", text.strip())
    if match is None or not all(16 <= int(number) <= 8192 for number in match.groups()):
        raise typer.BadParameter(
            f"expected WxH with numbers from 16 to 8192, such as 800x450, found {text!r}", param_hint="--resolution"
        )
    return int(match[1]), int(match[2])
