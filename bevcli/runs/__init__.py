"""The files of a run: what `bevcli run` adds to `bevcli.run`, and its options."""

from dataclasses import field
from pathlib import Path

from bevcli.inference import StepOptions
from bevcli.options import option, options
from bevcli.recording import RecordingOptions


@options("Model")
class RunOptions(StepOptions):
    """The options of a run. recording: content of recording.rrd; what it shows decides on `attention` and `probes`."""

    recording: RecordingOptions = field(default_factory=RecordingOptions)
    save_bev: Path | None = option(
        default=None,
        help="Write the BEV features of each frame, as float16 .npy files; row 0 has the smallest y.",
        panel="Output",
        metavar="DIR",
    )
    score_without_labels: bool = option(
        default=False,
        help="Print how well the boxes agree with a detector in the images, and draw what it sees; the drive needs no "
        "ground truth.",
        panel="Output",
    )


@options("Output")
class OutputOptions:
    """The output folder of `bevcli run`."""

    out: Path | None = option(default=None, help="Default: runs/SEQUENCE-MODEL.")
    force: bool = option(default=False, help="Replace the files of an earlier run in the output folder.")
    resume: bool = option(
        default=False,
        help="Go on with an interrupted run in the output folder, after its last saved frame. The model, the options "
        "and the input must be the same.",
    )
    live: bool = option(
        default=False, help="Open a viewer that shows the recording while it is written.", panel="Recording"
    )
