"""`bevcli viz`: shows a recording, or writes an image, a video, its boxes or a summary of it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def viz(
    recording: Annotated[Path, typer.Argument(help="A recording (.rrd), or the output folder of `bevcli run`.")],
    web: Annotated[bool, typer.Option("--web", help="Show it in the browser, even if there is a display.")] = False,
    host: Annotated[
        str, typer.Option(help="Address that the web viewer listens on. 0.0.0.0 allows access from other machines.")
    ] = "127.0.0.1",
    port: Annotated[
        int, typer.Option(help="Port of the web viewer. If it is in use, the next free one is taken.")
    ] = 9090,
    screenshot: Annotated[
        Path | None, typer.Option(metavar="OUT.png|.jpg", help="Write a screenshot of the viewer. Needs no screen.")
    ] = None,
    frame: Annotated[int | None, typer.Option(help="Frame index for --screenshot. Default: the first frame.")] = None,
    summary: Annotated[
        bool, typer.Option("--summary", help="Print the frames, time span, boxes per class and sizes.")
    ] = False,
    video: Annotated[
        Path | None,
        typer.Option(
            metavar="OUT.mp4|.webm",
            help="Write a video of all cameras and the BEV, with boxes: H.264 if PyAV is installed, else VP9.",
        ),
    ] = None,
    export: Annotated[
        Path | None, typer.Option(metavar="BOXES.csv|.json", help="Write the shown boxes in the world frame.")
    ] = None,
) -> None:
    """Show a recording in the viewer, or write an image, a video, its boxes or a summary.

    The viewer opens if none of --summary, --screenshot, --video and --export is given: in a window if there is a
    display, else in the browser at an address that only this machine can reach. Ctrl-C closes it.
    """
    from bevcli.viewer.recording_file import open_recording, recording_in

    if frame is not None and screenshot is None:
        raise typer.BadParameter("is only valid with --screenshot", param_hint="--frame")
    recording = recording_in(recording)
    with open_recording(recording) as file:
        if file.repaired:
            typer.echo(f"note: {recording} is incomplete (its run was stopped or is still going)")
        if summary:
            _summarise(recording, file.path)
        if screenshot is not None:
            _screenshot(file.path, screenshot, frame)
        if video is not None:
            _video(file.path, video)
        if export is not None:
            _export(file.path, export)
        if not (summary or screenshot or video or export):
            _open(file.path, web=web, host=host, port=port)


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
    typer.echo(f"{video}: {count} frames, {rate:.3g} per second")


def _export(recording: Path, path: Path) -> None:
    from bevcli.viewer.export import export_boxes

    frames, boxes = export_boxes(recording, path)
    typer.echo(f"{path}: {boxes} boxes in {frames} frames")


def _open(recording: Path, *, web: bool, host: str, port: int) -> None:
    from bevcli.viewer.native import display_is_there
    from bevcli.viewer.web import WebViewer, web_viewer_assets

    if display_is_there() and not web:
        if _show_window(recording):
            return
        typer.echo("note: the viewer's window did not open; use the browser instead")
    viewer = WebViewer(web_viewer_assets(), recording, host, port)
    typer.echo(f"{viewer.address}  Open this address in a browser. Ctrl-C stops the server.")
    viewer.serve()


def _show_window(recording: Path) -> bool:
    """Opens the viewer and waits until the user closes it. False if the viewer failed."""
    from bevcli.viewer.native import LOOPBACK, start_viewer, stop

    process = start_viewer("--bind", LOOPBACK, "--port", "auto", str(recording))
    try:
        return process.wait() == 0
    finally:
        stop(process)
