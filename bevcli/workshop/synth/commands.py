"""`bevcli render` renders a drive; `bevcli demo` renders a short one, runs it and opens the viewer."""

from pathlib import Path
from typing import Annotated, Any

from bevcli.cli.bridge import argument
from bevcli.cli.progress import Progress
from bevcli.cli.run import run
from bevcli.inference import ModelOptions
from bevcli.printing import counted, say
from bevcli.recording import RecordingOptions
from bevcli.runs import OutputOptions, RunOptions
from bevcli.sequences.options import InputOptions
from bevcli.viewer import ViewOptions
from bevcli.workshop.synth import DemoOptions, RenderOptions

PANEL = "Start"
DEMO_RESOLUTION = (800, 450)


def render(out: Annotated[Path, argument("The sequence folder to write.", reads=None)], options: RenderOptions) -> None:
    """Render a drive through a procedural city as a sequence with ground truth boxes and maps."""
    from bevcli.workshop.synth import drive as rendering, shading_kernels

    if not is_compiled(shading_kernels.shade_pixels):
        say("note: the first rendering on a computer compiles the renderer, about 15 s", err=True)
    drive = rendering.drive_of(options)
    with Progress(options.frames, "frames") as progress:
        for _ in rendering.export_frames(drive, out, force=options.force, quality=options.quality):
            progress.advance()
    size = f"{counted(drive.frames, 'frames')}, {counted(len(drive.rig.cameras), 'cameras')}"
    say(f"{out}: {size}, {drive.weather.name}, seed {drive.seed}")


def demo(options: DemoOptions) -> None:
    """Render a short drive, run BEVFormer on it and open the recording.

    The demo model was trained on rendered drives only.
    """
    drive, results = options.out / "drive", OutputOptions(options.out / "results", options.force)
    render(drive, RenderOptions(options.seed, options.frames, resolution=DEMO_RESOLUTION, force=options.force))
    run(
        drive,
        model=ModelOptions(),
        run_options=RunOptions(),
        recording=RecordingOptions(),
        source=InputOptions(),
        output=results,
        format_options={},
    )
    if options.view:
        from bevcli.cli.viewing import show

        show(options.out / "results/recording.rrd", ViewOptions())


def is_compiled(function: Any) -> bool:
    """True if the cache has the compiled function of this file's present state."""
    code = function.py_func.__code__
    name = f"{Path(code.co_filename).stem}.{function.py_func.__qualname__}-{code.co_firstlineno}.*.nbi"
    folder, changed = function.stats.cache_path, Path(code.co_filename).stat().st_mtime
    return folder is not None and any(file.stat().st_mtime >= changed for file in Path(folder).glob(name))
