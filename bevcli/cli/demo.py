"""`bevcli demo`: the whole chain with nothing at hand: render a drive, run the model on it, open the viewer."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

RESOLUTION = "800x450"


def demo(
    out: Annotated[Path, typer.Option(help="The folder for the drive and the results.")] = Path("runs/demo"),
    seed: Annotated[
        int, typer.Option(min=0, help="Which street; the model was taught none from 1000000 on.")
    ] = 1_000_001,
    frames: Annotated[int, typer.Option(min=1, help="How many frames, two a second.")] = 8,
    view: Annotated[bool, typer.Option("--view/--no-view", help="Open the viewer at the end.")] = True,
    force: Annotated[bool, typer.Option("--force", help="Replace an earlier demo in OUT.")] = False,
) -> None:
    """Render a short drive, run BEVFormer on it and open the recording.

    The model has seen nothing but rendered streets, and knows no others.
    """
    from bevcli.cli.render import render
    from bevcli.cli.run import run
    from bevcli.cli.viz import viz

    drive, results = out / "drive", out / "results"
    render(drive, seed=seed, frames=frames, resolution=RESOLUTION, force=force)
    run(drive, out=results, force=force)
    if view:
        viz(results / "recording.rrd")
