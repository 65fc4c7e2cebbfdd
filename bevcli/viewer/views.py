"""Images and videos of a recording, as `bevcli viz` writes them."""

from collections.abc import Callable
from pathlib import Path

from bevcli.viewer.native import take_screenshot
from bevcli.viewer.recording_file import open_recording
from bevcli.viewer.video import frame_rate, write_video


def screenshot(recording: str | Path, image: str | Path, *, frame: int | None = None) -> tuple[str, ...]:
    """Write an image of the viewer with a recording; return the names of its views.

        bevcli.screenshot("street.rrd", "street.png", frame=3)

    Needs a Vulkan driver, but no screen and no GPU. `Prediction.plot` needs neither, and no recording.

    Args:
        recording: a recording, or the folder of a run.
        image: the .png, .jpg or .jpeg file to write.
        frame: index of the frame. Default: the first one.

    Raises:
        InputError: there is no such recording or frame, or the image has another ending.
        OutputError: the viewer cannot draw, or the file cannot be written.
    """
    with open_recording(Path(recording)) as file:
        return take_screenshot(file, Path(image), frame)


def video(
    recording: str | Path, video: str | Path, *, on_frame: Callable[[], None] = lambda: None
) -> tuple[int, float]:
    """Write a video of a recording with all cameras and the map from above; return its frames, and those a second.

        bevcli.video("street.rrd", "street.mp4")

    H.264 if PyAV is installed (`bevcli[video]`), else VP9.

    Args:
        recording: a recording, or the folder of a run.
        video: the .mp4 or .webm file to write.
        on_frame: called after each frame.

    Raises:
        InputError: there is no such recording, it has no frames, or the video has another ending.
        OutputError: the video cannot be written.
    """
    with open_recording(Path(recording)) as file:
        count, rate = frame_rate(file)
        write_video(file, Path(video), count, rate, on_frame)
    return count, rate
