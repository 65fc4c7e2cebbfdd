"""`bevcli viz`: opens a recording, or makes an image, a video, a table or a summary of it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def viz(
    recording: Annotated[Path, typer.Argument(help="A recording that `bevcli run` wrote, such as recording.rrd.")],
    web: Annotated[bool, typer.Option("--web", help="Open it in the browser, also where there is a display.")] = False,
    host: Annotated[
        str, typer.Option(help="The address that the web viewer listens on. 0.0.0.0 lets other machines in.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="The web viewer's port; where it is in use, the next free one.")] = 9090,
    screenshot: Annotated[
        Path | None, typer.Option(metavar="OUT.png", help="Write an image of the viewer; needs no screen.")
    ] = None,
    frame: Annotated[int | None, typer.Option(help="The number of the frame in the image. Default: the first.")] = None,
    summary: Annotated[bool, typer.Option("--summary", help="Print what the recording holds.")] = False,
    video: Annotated[
        Path | None,
        typer.Option(metavar="OUT.mp4|.webm", help="Write a video (VP9) of all cameras, with boxes, and the BEV."),
    ] = None,
    export: Annotated[
        Path | None, typer.Option(metavar="BOXES.csv|.json", help="Write the shown boxes, in the world frame.")
    ] = None,
) -> None:
    """Look at a recording: in the viewer, or as an image, a video, a table or a summary.

    Without an option that writes something, the viewer opens: in a window where there is a display, else in the
    browser, at an address of this machine only. Ctrl-C ends it.
    """
    from bevcli.viewer.recording_file import whole_recording

    if frame is not None and screenshot is None:
        raise typer.BadParameter("--frame goes with --screenshot", param_hint="--frame")
    with whole_recording(recording) as whole:
        if whole.mended:
            typer.echo(f"note: {recording} has no end: its run was cut off or is still going. Shown is what it has.")
        if summary:
            _summarise(recording, whole.path)
        if screenshot is not None:
            _screenshot(whole.path, screenshot, frame)
        if video is not None:
            _video(whole.path, video)
        if export is not None:
            _export(whole.path, export)
        if not (summary or screenshot or video or export):
            _open(whole.path, web=web, host=host, port=port)


def _summarise(recording: Path, read_from: Path) -> None:
    from bevcli.viewer.summary import summarise

    typer.echo(summarise(recording, read_from).text())


def _screenshot(recording: Path, image: Path, frame: int | None) -> None:
    from bevcli.viewer.screenshot import take_screenshot

    views = take_screenshot(recording, image, frame)
    typer.echo(f"{image}: {len(views)} views")


def _video(recording: Path, video: Path) -> None:
    from bevcli.cli.progress import Progress
    from bevcli.viewer.video import frame_rate, write_video

    count, rate = frame_rate(recording)
    with Progress(count, "frames") as progress:
        write_video(recording, video, progress.advance)
    typer.echo(f"{video}: {count} frames at {rate:.3g} a second")


def _export(recording: Path, path: Path) -> None:
    from bevcli.viewer.export import export_boxes

    frames, boxes = export_boxes(recording, path)
    typer.echo(f"{path}: {boxes} boxes of {frames} frames")


def _open(recording: Path, *, web: bool, host: str, port: int) -> None:
    from bevcli.viewer.native import display_is_there
    from bevcli.viewer.web import WebViewer, web_viewer_assets

    if display_is_there() and not web:
        if _window_closed_well(recording):
            return
        typer.echo("note: the viewer's window did not open; here it is for the browser")
    viewer = WebViewer(web_viewer_assets(), recording, host, port)
    typer.echo(f"{viewer.address}  open this in a browser; Ctrl-C ends it")
    viewer.serve()


def _window_closed_well(recording: Path) -> bool:
    from bevcli.viewer.native import LOOPBACK, start_viewer, stop

    process = start_viewer("--bind", LOOPBACK, "--port", "auto", str(recording))
    try:
        return process.wait() == 0
    finally:
        stop(process)
