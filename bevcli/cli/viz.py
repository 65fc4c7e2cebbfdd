"""`bevcli viz`: shows a recording, or writes an image, a video or a summary of it."""

from pathlib import Path
from typing import Annotated

import typer

from bevcli.cli.bridge import argument
from bevcli.printing import counted, say
from bevcli.viewer.options import ViewOptions

PANEL = "Look"


def viz(
    recording: Annotated[Path, argument("A recording (.rrd), or the output folder of `bevcli run`.")],
    options: ViewOptions,
) -> None:
    """Show a recording in the viewer, or write an image, a video or a summary.

    The viewer opens if none of --summary, --screenshot and --video is given: in a window if there is a
    display, else in the browser at an address that only this machine can reach. Ctrl-C closes it.
    """
    from bevcli.viewer.recording_file import open_recording, recording_in

    if options.frame is not None and options.screenshot is None:
        raise typer.BadParameter("is only valid with --screenshot", param_hint="--frame")
    recording = recording_in(recording)
    with open_recording(recording) as file:
        if file != recording:
            say(f"note: {recording} is incomplete (its run was stopped or is still going)")
        if options.summary or options.screenshot or options.video:
            _write(recording, file, options)
        else:
            _open(file, options)


def _write(recording: Path, read_from: Path, options: ViewOptions) -> None:
    """Write what the options name. read_from: the recording, or a repaired copy of it."""
    from bevcli.cli.progress import Progress
    from bevcli.viewer.native import take_screenshot
    from bevcli.viewer.recording_reader import summarise
    from bevcli.viewer.video import frame_rate, write_video

    if options.summary:
        say(summarise(recording, read_from).text())
    if options.screenshot is not None:
        views = take_screenshot(read_from, options.screenshot, options.frame)
        say(f"{options.screenshot}: {len(views)} views")
    if options.video is not None:
        count, rate = frame_rate(read_from)
        with Progress(count, "frames") as progress:
            write_video(read_from, options.video, count, rate, progress.advance)
        say(f"{options.video}: {counted(count, 'frames')}, {rate:.3g} per second")


def _open(recording: Path, options: ViewOptions) -> None:
    from bevcli.viewer.native import display_is_there, show_window
    from bevcli.viewer.web import WebViewer, web_viewer_assets

    if display_is_there() and not options.web:
        if show_window(recording):
            return
        say("note: the viewer's window did not open; use the browser instead")
    viewer = WebViewer(web_viewer_assets(), recording, options.host, options.port)
    say(f"{viewer.address}  Open this address in a browser. Ctrl-C stops the server.")
    viewer.serve()
