"""Reads recordings and shows them: what `bevcli viz` does, and its options.

recording_file     checks a file, repairs a copy of one that was cut off, and shows one in a notebook
recording_reader   reads a recording frame by frame, its boxes, and its summary
native, web        the viewer in a window, for a screenshot and in the browser, also while a recording is written
"""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Literal

from bevcli.options import option, options

VideoView = Literal["all", "images"]


def parse_host(text: str) -> str:
    """An address of this machine to listen on, unchanged. Raises ValueError."""
    expected = "expected an address of this machine, such as 127.0.0.1"
    if not text.strip():
        raise ValueError(f"is empty ({expected})")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(text, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as tried:
            tried.bind(address)
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or "not a host name"
        raise ValueError(f'"{text[:60]}": cannot listen there ({reason}; {expected})') from None
    return text


@options()
class ViewOptions:
    """The viewer, or what is written in its place."""

    boxes: tuple[Path, ...] = option(
        reads="path",
        default=(),
        help="Boxes of a model that are shown against the labels of DRIVE: what `bevcli eval` reads. Give it twice to "
        "compare two models.",
        metavar="FILE",
        repeatable=True,
        panel="Drive",
    )
    out: Path | None = option(
        default=None, help="Write the recording of DRIVE to this .rrd file.", metavar="FILE.rrd", panel="Drive"
    )
    web: bool = option(default=False, help="Show it in the browser, even if there is a display.")
    host: str = option(
        default="127.0.0.1",
        help="Address that the web viewer listens on. 0.0.0.0 allows access from other machines. Default: 127.0.0.1.",
        metavar="ADDRESS",
        parse=parse_host,
    )
    port: int = option(
        default=9090,
        help="Port of the web viewer. If it is in use, the next free one is taken.",
        minimum=1,
        maximum=65535,
    )
    screenshot: Path | None = option(
        default=None,
        help="Write a screenshot of the viewer. Needs a Vulkan driver, but no screen and no GPU.",
        metavar="OUT.png|.jpg",
    )
    frame: int | None = option(
        default=None,
        help="Frame index, where the viewer's window opens, or for --screenshot. Default: the first frame.",
    )
    summary: bool = option(default=False, help="Print the frames, time span, boxes per class and sizes.")
    video: Path | None = option(
        default=None,
        help="Write a video of all cameras and the BEV, with boxes: H.264 if PyAV is installed, else VP9.",
        metavar="OUT.mp4|.webm",
    )
    view: VideoView = option(
        default="all",
        help="What --video shows. images: the images with the boxes and nothing else, at their own size and rate.",
    )
