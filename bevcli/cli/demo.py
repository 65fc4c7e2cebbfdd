"""`bevcli demo`: render a short drive, run the model on it and open the viewer; needs no other data."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

RESOLUTION = "800x450"


def demo(
    out: Annotated[Path, typer.Option(help="Folder for the drive and the results.")] = Path("runs/demo"),
    seed: Annotated[
        int, typer.Option(min=0, help="Seed of the drive. The model was trained on seeds below 1000000 only.")
    ] = 1_000_001,
    frames: Annotated[int, typer.Option(min=1, help="Number of frames, two per second.")] = 8,
    view: Annotated[bool, typer.Option("--view/--no-view", help="Open the viewer at the end.")] = True,
    force: Annotated[bool, typer.Option("--force", help="Replace an earlier demo in OUT.")] = False,
) -> None:
    """Render a short drive, run BEVFormer on it and open the recording.

    The demo model was trained on rendered drives only.
    """
    from bevcli.cli.render import render
    from bevcli.cli.run import run
    from bevcli.cli.viz import viz

    drive, results = out / "drive", out / "results"
    render(drive, seed=seed, frames=frames, resolution=RESOLUTION, force=force)
    run(drive, out=results, force=force)
    if view:
        viz(results / "recording.rrd")
