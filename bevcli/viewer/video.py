"""A recording as a video file, made from what it holds: VP9, which Chromium and Firefox play."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np

from bevcli.errors import InputError, OutputError
from bevcli.recording import entities
from bevcli.viewer.recording_reader import RecordedFrame, RecordingReader
from bevcli.viewer.video_frame import HEIGHT, WIDTH, Tile, camera_rows_of, draw_frame, tiles

# OpenCV's wheels write VP9 but not H.264.
FOURCC = {".mp4": "vp09", ".webm": "VP90"}
SLOWEST, FASTEST = 1.0, 30.0  # frames a second


def write_video(recording: Path, video: Path, on_frame: Callable[[], None] = lambda: None) -> int:
    """Writes the video and returns the number of frames; `on_frame` is called after each.

    Raises InputError for another ending than .mp4 or .webm, or a recording without frames; OutputError where the
    video cannot be written.
    """
    if video.suffix.lower() not in FOURCC:
        raise InputError(f"--video {video}: the file must end in .mp4 or .webm")
    count, rate = frame_rate(recording)
    if not count:
        raise InputError(f"{recording}: the recording has no frames")
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*FOURCC[video.suffix.lower()]), rate, (WIDTH, HEIGHT))
    if not writer.isOpened():
        raise OutputError(f"{video}: the video cannot be written (is the folder there, and may you write in it?)")
    try:
        for image in _images(recording):
            writer.write(image)
            on_frame()
    finally:
        writer.release()
    return count


def frame_rate(recording: Path) -> tuple[int, float]:
    """How many frames a recording has, and how many of them a second, by the median of the times between them."""
    times = frame_times_ns(recording)
    steps = np.diff(times)
    seconds = float(np.median(steps[steps > 0])) / 1e9 if (steps > 0).any() else 1.0
    return len(times), float(np.clip(1 / seconds, SLOWEST, FASTEST))


def frame_times_ns(recording: Path) -> np.ndarray:
    """The frames' times, read without their images."""
    times: dict[int, int] = {}
    for chunk in RecordingReader(recording).chunks():
        if chunk.entity_path.strip("/") == entities.EGO:
            batch = chunk.to_record_batch()
            if "timestamp_ns" in batch.schema.names:
                frames = batch.column(entities.FRAME_TIMELINE).to_pylist()
                stamps = batch.column("timestamp_ns").to_pylist()
                times.update({f: stamp[0] for f, stamp in zip(frames, stamps, strict=True) if stamp})
    return np.array([times[frame] for frame in sorted(times)], dtype=np.int64)


def _images(recording: Path) -> Iterator[np.ndarray]:
    placed: tuple[Tile, ...] | None = None
    for frame in RecordingReader(recording).frames():
        if placed is None:
            placed = tiles(camera_rows_of(frame), image_sizes(frame))
        yield draw_frame(frame, placed)


def image_sizes(frame: RecordedFrame) -> dict[str, tuple[int, int]]:
    """(width, height) of each camera's images, pixels."""
    sizes = {}
    for name in frame.values(entities.RUN, "camera_names"):
        width, height = frame.array(entities.camera(name), "Pinhole:resolution", 2)[0]
        sizes[name] = int(width), int(height)
    return sizes
