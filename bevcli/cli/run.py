"""`bevcli run`: a sequence in, boxes and a recording out."""

import shlex
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from bevcli.cli.bridge import Part, as_flags
from bevcli.inference.options import ModelOptions
from bevcli.recording.options import RecordingOptions
from bevcli.runs.options import OutputOptions, RunOptions
from bevcli.sequences.format import option_classes
from bevcli.sequences.options import SequenceOptions

if TYPE_CHECKING:
    from bevcli.frame import Frame, Prediction


def run(
    sequence: Annotated[
        Path,
        typer.Argument(help="Sequence folder (images or videos), nuScenes root, .mcap file or rosbag2 folder."),
    ],
    model: ModelOptions,
    run_options: RunOptions,
    recording: RecordingOptions,
    source: SequenceOptions,
    output: OutputOptions,
    format_options: Annotated[dict[str, Any], Part(classes=option_classes)],
) -> None:
    """Run BEVFormer on SEQUENCE, frame by frame, and write boxes and a recording.

    The output folder gets recording.rrd (open it with `bevcli viz`), predictions.json (all boxes of all frames),
    tracks.csv (one row a box with its track), summary.json and, for models that predict a map, segmentation/.
    Ctrl-C or SIGTERM finish the current frame; a second one ends the program at once.
    """
    from bevcli.cli.progress import Progress
    from bevcli.cli.stop_signals import StopSignals
    from bevcli.inference.load import load_model
    from bevcli.runs.notes import frame_warnings, run_notes
    from bevcli.runs.run_into_folder import run_into_folder
    from bevcli.sequences.open import open_sequence

    loaded = load_model(options=model)
    reading = source.for_model(loaded.config, temporal=run_options.temporal)
    drive = open_sequence(sequence, reading, **format_options)
    out = output.out or Path("runs") / f"{drive.name}-{loaded.name}"
    view = None
    if output.live:
        from bevcli.viewer.web import LiveView

        view = LiveView()

    def show(frame: "Frame", prediction: "Prediction") -> None:
        for warning in frame_warnings(frame, prediction):
            progress.message(f"warning: {warning}")
        progress.advance()

    notes = run_notes(loaded, drive, live=output.live)
    with Progress(len(drive.stamps), "frames", notes) as progress, StopSignals("frame") as signals:
        summary = run_into_folder(
            loaded,
            drive,
            out,
            replace(run_options, recording=recording),
            live=view,
            force=output.force,
            resume=output.resume,
            after_frame=show,
            resumed=progress.skip,
            should_stop=signals.received,
        )
    print(as_flags(summary.table()))
    if signals.received() and not summary.is_complete:
        print(f"stopped; `--resume` goes on with frame {summary.frames + 1} of {len(drive.stamps)}", file=sys.stderr)
        raise typer.Exit(signals.exit_code)
    print(f"next     bevcli viz {shlex.quote(str(out))}")
