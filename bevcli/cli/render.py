"""`bevcli render`: a drive through a rendered city as a sequence folder with ground truth."""

from __future__ import annotations

import re
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer


class WeatherChoice(StrEnum):
    """The values of --weather."""

    NOON = "noon"
    EVENING = "evening"
    OVERCAST = "overcast"


def render(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="The sequence folder to write.")],
    seed: Annotated[int, typer.Option(min=0, help="Seed of the drive. The same seed gives the same files.")] = 0,
    frames: Annotated[int, typer.Option(min=1, help="Number of frames.")] = 20,
    rig: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="The cameras, a calibration.json. Default: six cameras like nuScenes."),
    ] = None,
    rate: Annotated[float, typer.Option(metavar="HZ", min=0.1, max=100, help="Frames per second.")] = 2.0,
    resolution: Annotated[
        str | None,
        typer.Option(metavar="WxH", help="Size of the images in pixels, such as 800x450. Default: that of the rig."),
    ] = None,
    weather: Annotated[WeatherChoice | None, typer.Option(help="Light and sky. Default: drawn from the seed.")] = None,
    quality: Annotated[int, typer.Option(min=1, max=100, help="JPEG quality.")] = 90,
    supersampling: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=4,
            help="Supersampling factor per axis (anti-aliasing). Default: 2 up to 1000 pixels wide, else 1.",
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace a sequence in OUT.")] = False,
) -> None:
    """Render a drive through a procedural city as a sequence with ground truth boxes and maps."""
    size = parse_resolution(resolution)
    from bevcli.cli.progress import Progress
    from bevcli.synth.export import render as render_sequence

    typer.echo("note: the first rendering on a computer compiles the renderer, about 15 s", err=True)
    with Progress(frames, "frames") as progress:
        summary = render_sequence(
            out, seed, frames, rig, rate, size, None if weather is None else weather.value, quality, supersampling,
            force, lambda frame: progress.advance(),
        )  # fmt: skip
    cameras = len(summary.cameras)
    typer.echo(f"{summary.folder}: {summary.frames} frames, {cameras} cameras, {summary.weather}, seed {summary.seed}")


def parse_resolution(text: str | None) -> tuple[int, int] | None:
    """Parse a resolution: "800x450" is (800, 450), None is None. Raises typer.BadParameter for other texts."""
    if text is None:
        return None
    match = re.fullmatch(r"(\d+)[x×](\d+)", text.strip())
    if match is None or not all(16 <= int(number) <= 8192 for number in match.groups()):
        raise typer.BadParameter(
            f"expected WxH with numbers from 16 to 8192, such as 800x450, found {text!r}", param_hint="--resolution"
        )
    return int(match[1]), int(match[2])
