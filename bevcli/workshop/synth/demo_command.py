"""`bevcli demo`: render a short drive, run the model on it and open the viewer; needs no other data."""

from bevcli.inference.options import ModelOptions
from bevcli.recording.options import RecordingOptions
from bevcli.runs.options import OutputOptions, RunOptions
from bevcli.sequences.options import SequenceOptions
from bevcli.viewer.options import ViewOptions
from bevcli.workshop.synth.options import DemoOptions, RenderOptions

PANEL = "Start"
RESOLUTION = (800, 450)


def demo(options: DemoOptions) -> None:
    """Render a short drive, run BEVFormer on it and open the recording.

    The demo model was trained on rendered drives only.
    """
    from bevcli.cli.run import run
    from bevcli.cli.viz import viz
    from bevcli.workshop.synth.command import render

    drive, results = options.out / "drive", OutputOptions(options.out / "results", options.force)
    render(drive, RenderOptions(options.seed, options.frames, resolution=RESOLUTION, force=options.force))
    run(drive, ModelOptions(), RunOptions(), RecordingOptions(), SequenceOptions(), (), results, {})
    if options.view:
        viz(options.out / "results/recording.rrd", ViewOptions())
