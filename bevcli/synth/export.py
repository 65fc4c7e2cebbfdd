"""A rendered drive as a sequence folder: `render` makes the drive and writes it, `export_drive` writes a given one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.frame import CameraImage, DriveFacts, Frame
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import CameraRig
from bevcli.sequences.native.ego_motion_file import write_ego_motion
from bevcli.sequences.native.writer import NativeWriter
from bevcli.synth.drive import RenderedDrive, RenderedFrame
from bevcli.synth.rig import rig_for_rendering

JPEG_QUALITY = 90
EGO_MOTION_HZ = 50.0
SUPERSAMPLED_WIDTH = 1000  # images up to this width are supersampled by default
THREADS = 2


@dataclass(frozen=True)
class RenderSummary:
    """What `render` has written.

    Attributes:
        folder: the sequence folder.
        seed: seed of the drive.
        frames: number of frames.
        cameras: names of the cameras.
        weather: name of the weather.
    """

    folder: Path
    seed: int
    frames: int
    cameras: tuple[str, ...]
    weather: str


def render(
    out: str | Path,
    seed: int = 0,
    frames: int = 20,
    rig: str | Path | CameraRig | None = None,
    rate_hz: float = 2.0,
    resolution: tuple[int, int] | None = None,
    weather: str | None = None,
    quality: int = JPEG_QUALITY,
    supersampling: int | None = None,
    force: bool = False,
    progress: Callable[[RenderedFrame], None] | None = None,
) -> RenderSummary:
    """Render a drive through a procedural city and write it as a sequence with ground truth boxes and maps.

    The same arguments give the same files. The first call on a computer compiles the renderer, which takes about 15 s.

    Args:
        out: the sequence folder to write.
        seed: the drive; 0 or greater. The models of this project were trained on seeds below 1,000,000 only.
        frames: number of frames, 1 or more.
        rig: the cameras, or the path of a calibration.json; default: six cameras like those of nuScenes.
        rate_hz: frames per second, 0.1 to 100.
        resolution: width and height of the images, 16 to 8192 pixels each; default: that of the rig.
        weather: "noon", "evening" or "overcast"; default: drawn from the seed.
        quality: JPEG quality, 1 to 100.
        supersampling: samples per pixel along each axis (anti-aliasing), 1 to 4; default: 2 for images up to 1000
            pixels wide, 1 for wider ones.
        force: whether to replace a sequence in `out`.
        progress: called with each frame after it is written.

    Raises:
        InputError: an argument is out of range, the calibration file is wrong, or a camera's field of view is too wide.
        OutputError: `out` contains a sequence and `force` is false, or it cannot be written.
    """
    _check("seed", seed, 0)
    _check("frames", frames, 1)
    _check("rate_hz", rate_hz, 0.1, 100)
    _check("quality", quality, 1, 100)
    for size in resolution or ():
        _check("resolution", size, 16, 8192)
    if supersampling is not None:
        _check("supersampling", supersampling, 1, 4)
    cameras = rig_for_rendering(rig, resolution)
    width = max(camera.width for camera in cameras.cameras)
    samples = supersampling or (2 if width <= SUPERSAMPLED_WIDTH else 1)
    drive = RenderedDrive(seed, frames, rate_hz, cameras, weather, supersampling=samples, threads=THREADS)
    folder = Path(out)
    export_drive(drive, folder, force=force, quality=quality, progress=progress)
    return RenderSummary(folder, seed, frames, cameras.names, drive.weather.name)


def _check(name: str, value: float, low: float, high: float = float("inf")) -> None:
    """Raise InputError where a number is not in the range from low to high."""
    if not low <= value <= high:
        wanted = f"{low} or more" if high == float("inf") else f"{low} to {high}"
        raise InputError(f"{name}: expected {wanted}, found {value}")


def export_drive(
    drive: RenderedDrive,
    folder: Path,
    *,
    force: bool = False,
    quality: int = JPEG_QUALITY,
    progress: Callable[[RenderedFrame], None] | None = None,
) -> None:
    """Render all frames of a drive and write them, with ego-motion at EGO_MOTION_HZ, ground truth boxes and maps.

    folder: the sequence folder. force: whether to replace a sequence in it. quality: JPEG quality, 1 to 100.
    progress: called with each frame after it is written.
    Raises OutputError where the folder contains a sequence and `force` is false, or cannot be written.
    """
    motion = drive.ego_motion(EGO_MOTION_HZ)
    with NativeWriter(folder, with_ego_motion=True, force=force, facts=DriveFacts(rendered=True)) as writer:
        for index in range(drive.frames):
            rendered = drive.frame(index)
            kinematics = motion.kinematics_at(rendered.stamp.timestamp_ns)
            images = {
                name: CameraImage(time_ns, pixels, _encode_jpeg(pixels, quality), "image/jpeg")
                for (name, pixels), time_ns in zip(
                    rendered.images.items(), rendered.camera_timestamps_ns.values(), strict=True
                )
            }
            writer.write(
                Frame(
                    rendered.stamp, drive.rig, images, rendered.world_from_ego,
                    rendered.world_from_ego_at, kinematics,
                    ground_truth=_rounded(rendered.boxes), ground_truth_map=rendered.bev_map,
                )
            )  # fmt: skip
            if progress is not None:
                progress(rendered)
    # The writer has written a pose for each frame. Replace them by denser ones, so that cameras may have time offsets.
    write_ego_motion(folder / "ego_motion.csv", motion)


def _encode_jpeg(pixels_bgr: NDArray[np.uint8], quality: int) -> bytes:
    """The bytes of a JPEG file."""
    return cv2.imencode(".jpg", pixels_bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def _rounded(boxes: Boxes3D) -> Boxes3D:
    """The boxes rounded to 0.1 mm and 10 microradians, which keeps the files small."""
    return replace(
        boxes,
        centers=np.round(boxes.centers, 4),
        sizes_lwh=np.round(boxes.sizes_lwh, 4),
        yaws=np.round(boxes.yaws, 5),
        velocities=np.round(boxes.velocities, 4),
        visibilities=None if boxes.visibilities is None else np.round(boxes.visibilities, 4),
    )
