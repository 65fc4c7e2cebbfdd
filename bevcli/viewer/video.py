"""Writes a video of a recording: H.264 in MP4, which plays everywhere, if PyAV is installed; VP9 else and in WebM."""

import errno
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np

from bevcli.errors import InputError
from bevcli.parsing.files import plain_name
from bevcli.recording import entities
from bevcli.recording.video_images import has_av
from bevcli.viewer.recording_reader import RecordingReader
from bevcli.viewer.video_frame import HEIGHT, WIDTH, CameraImages, Tile, draw_frame, tiles
from bevcli.writing import whole_file

FOURCC = {".mp4": "vp09", ".webm": "VP90"}  # VP9: OpenCV's wheels cannot write H.264
H264_QUALITY = 21  # x264's crf
SLOWEST, FASTEST = 1.0, 30.0  # frames a second


def write_video(recording: Path, video: Path, count: int, rate: float, on_frame: Callable[[], None]) -> None:
    """Writes the video. count, rate: of `frame_rate`. on_frame: called after each frame.

    Raises InputError if the path does not end in .mp4 or .webm or the recording has no frames, OutputError if the video
    cannot be written.
    """
    if video.suffix.lower() not in FOURCC:
        raise InputError(f"{video}: the file must end in .mp4 or .webm")
    if not count:
        raise InputError(f"{recording}: the recording has no frames")
    encoder = _h264 if video.suffix.lower() == ".mp4" and has_av() else _vp9
    with whole_file(video) as own, plain_name(own) as unfinished:
        with encoder(unfinished, rate) as write:
            for image in _images(recording):
                write(image)
                on_frame()
        _check_complete(unfinished, count)


def _check_complete(video: str, count: int) -> None:
    """Raises OSError where a video lacks frames: OpenCV does not tell that a disk is full."""
    found = cv2.VideoCapture(video)
    if not (found.isOpened() and found.get(cv2.CAP_PROP_FRAME_COUNT) >= count - 1):  # computed from the times in a WebM
        raise OSError(errno.ENOSPC, "not all frames are in the file: is the disk full?")


@contextmanager
def _vp9(video: str, rate: float) -> Iterator[Callable[[np.ndarray], object]]:
    writer = cv2.VideoWriter(video, cv2.VideoWriter.fourcc(*FOURCC[Path(video).suffix.lower()]), rate, (WIDTH, HEIGHT))
    if not writer.isOpened():
        raise OSError("OpenCV cannot open it: is its folder there and writable, and is there enough memory?")
    try:
        yield writer.write
    finally:
        writer.release()


@contextmanager
def _h264(video: str, rate: float) -> Iterator[Callable[[np.ndarray], object]]:
    import av

    with av.open(video, "w", options={"movflags": "+faststart"}) as container:
        exact = Fraction(rate).limit_denominator(1000)
        stream = container.add_stream("libx264", rate=exact, options={"crf": str(H264_QUALITY)})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        yield lambda image: container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
        container.mux(stream.encode(None))


def frame_rate(recording: Path) -> tuple[int, float]:
    """The number of frames, and the frames per second: 1 / the median time between frames, limited to 1 to 30.

    Images are not decoded.
    """
    frames = RecordingReader(recording).frames()
    times = np.array([frame.integers(entities.EGO, "timestamp_ns", 1)[0] for frame in frames], dtype=np.int64)
    steps = np.diff(times)
    seconds = float(np.median(steps[steps > 0])) / 1e9 if (steps > 0).any() else 1.0
    return len(times), float(np.clip(1 / seconds, SLOWEST, FASTEST))


def _images(recording: Path) -> Iterator[np.ndarray]:
    layout: tuple[Tile, ...] = ()
    images = CameraImages()
    for frame in RecordingReader(recording).frames():
        layout = layout or tiles(frame)
        yield draw_frame(frame, layout, images)
