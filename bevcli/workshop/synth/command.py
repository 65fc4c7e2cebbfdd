"""`bevcli render`: a drive through a rendered city as a sequence folder with ground truth."""

from pathlib import Path
from typing import Annotated

from bevcli.cli.bridge import argument
from bevcli.printing import counted, say
from bevcli.workshop.synth.options import RenderOptions

PANEL = "Start"


def render(out: Annotated[Path, argument("The sequence folder to write.", reads=None)], options: RenderOptions) -> None:
    """Render a drive through a procedural city as a sequence with ground truth boxes and maps."""
    from bevcli.cli.progress import Progress
    from bevcli.jit import is_compiled
    from bevcli.workshop.synth.drive import render as render_sequence
    from bevcli.workshop.synth.shading_kernels import shade_pixels

    if not is_compiled(shade_pixels):
        say("note: the first rendering on a computer compiles the renderer, about 15 s", err=True)
    with Progress(options.frames, "frames") as progress:
        summary = render_sequence(out, options, progress=lambda frame: progress.advance())
    size = f"{counted(summary.frames, 'frames')}, {counted(len(summary.cameras), 'cameras')}"
    say(f"{summary.folder}: {size}, {summary.weather}, seed {summary.seed}")
