"""The options of a run and its files."""

from collections.abc import Mapping
from dataclasses import field
from functools import partial
from pathlib import Path

from bevcli.options import option, options, parse_pairs
from bevcli.recording.options import RecordingOptions


@options("Model")
class RunOptions:
    """The options of a run. recording: content of recording.rrd."""

    temporal: bool = option(default=True, help="Use the frames before (and after).", flag="--temporal/--no-temporal")
    track: bool = option(
        default=True,
        help="Give boxes identities over time, and write tracks.csv. A UniAD with history gives its own.",
        flag="--track/--no-track",
    )
    cameras: Mapping[str, str] = option(
        default_factory=dict,
        help="Use the embedding of MODEL_CAMERA for camera NAME. Repeatable. Default: the model's camera of the same "
        "name, else the one with the nearest viewing direction.",
        flag="--camera",
        metavar="NAME=MODEL_CAMERA",
        parse=partial(parse_pairs, expected="NAME=MODEL_CAMERA"),
        repeatable=True,
    )
    command: str | None = option(
        default=None,
        help="Command of the driver, which marks one of the planned paths of a model that plans: straight, left or "
        "right, or a file with a command by frame index. Default: none is marked.",
        metavar="NAME|FILE.json",
    )
    recording: RecordingOptions = field(default_factory=RecordingOptions)
    save_bev: Path | None = option(
        default=None,
        help="Write the BEV features of each frame, as float16 .npy files; row 0 has the smallest y.",
        panel="Output",
        metavar="DIR",
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
