"""The work of `bevcli viz`: record a drive, write views of a recording, open the viewer."""

import shlex
import tempfile
from pathlib import Path

from bevcli.cli.bridge import FormatValues
from bevcli.cli.progress import Progress, open_with_bar
from bevcli.errors import InputError
from bevcli.printing import counted, say
from bevcli.recording import RecordingOptions
from bevcli.sequences.options import InputOptions
from bevcli.viewer import ViewOptions
from bevcli.viewer.recording_file import (
    RECORDING,
    check_is_drive,
    is_recording as is_recording,
    open_recording,
    recording_in as recording_in,
)
from bevcli.viewer.recording_reader import RecordingReader, summarise
from bevcli.viewer.rerun_viewer import WebViewer, display_is_there, show_window, take_screenshot, web_viewer_assets


def show(recording: Path, options: ViewOptions, name: Path | None = None) -> None:
    """Show a recording, or write what the options name. name: for texts, in place of that of a temporary file."""
    with open_recording(recording) as file:
        if file != recording:
            say(f"note: {recording} is incomplete (its run was stopped or is still going)")
        if options.summary or options.screenshot or options.video:
            _write_views(recording, file, options, name or recording)
        else:
            if not RecordingReader(file).is_of_a_run():
                say(f"note: {name or recording} has no frames of a run: another program wrote it, or it is damaged")
            _open_viewer(file, options)


def record_drive(
    path: Path, options: ViewOptions, recording: RecordingOptions, source: InputOptions, format_options: FormatValues
) -> None:
    """Record a drive and boxes, and show the recording."""
    from bevcli.workshop.scores.record import names_of, record_steps

    check_is_drive(path)
    if options.out is not None and options.out.suffix.lower() != ".rrd":
        raise InputError(f"{options.out}: the file must end in .rrd")
    boxes = names_of(options.boxes)
    drive = open_with_bar(path, source, format_options)
    indices = [stamp.index for stamp in drive.stamps]
    if options.frame is not None and options.frame not in indices:
        raise InputError(
            f"--frame {options.frame}: the drive has {counted(len(indices), 'frames')} from {min(indices)} to "
            f"{max(indices)}, and not this one"
        )
    with tempfile.TemporaryDirectory(prefix="bevcli-") as folder:
        file = options.out or Path(folder) / RECORDING
        with Progress(len(drive.stamps), "frames", drive.notes) as progress:
            for step in record_steps(drive, boxes, file, recording.score, source.class_map):
                if isinstance(step, str):
                    progress.message(step)
                    continue
                for warning in step.warnings:
                    progress.message(f"warning: {warning}")
                progress.advance()
        if options.out is not None:
            say(f"{file}: {counted(len(drive.stamps), 'frames')}; next: bevcli viz {shlex.quote(str(file))}")
        if options.out is None or options.summary or options.screenshot or options.video:
            show(file, options, path if options.out is None else file)


def _write_views(recording: Path, read_from: Path, options: ViewOptions, name: Path) -> None:
    """Write what the options name. read_from: the recording, or a repaired copy of it. name: for texts."""
    from bevcli.workshop.video import frame_rate, write_video

    if options.summary:
        say(summarise(recording, read_from).replace(str(recording), str(name), 1))
    if options.screenshot is not None:
        views = take_screenshot(read_from, options.screenshot, options.frame)
        say(f"{options.screenshot}: {len(views)} views")
    if options.video is not None:
        count, rate = frame_rate(read_from, options.view)
        with Progress(count, "frames") as progress:
            for _ in write_video(read_from, options.video, count, rate, options.view):
                progress.advance()
        say(f"{options.video}: {counted(count, 'frames')}, {rate:.3g} per second")


def _open_viewer(recording: Path, options: ViewOptions) -> None:
    if display_is_there() and not options.web:
        if show_window(recording, options.frame):
            return
        say("note: the viewer's window did not open; use the browser instead")
    if options.frame is not None:
        RecordingReader(recording).check_frame(options.frame)
        say(f"note: in the browser, set the timeline to frame {options.frame}")
    viewer = WebViewer(web_viewer_assets(), recording, options.host, options.port)
    say(f"{viewer.address}  Open this address in a browser. Ctrl-C stops the server.")
    viewer.serve()
