"""A rendered drive as a sequence folder: `render` makes the drive and writes it, `export_drive` writes a given one."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.frame import CameraImage, DriveFacts, Frame
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import CameraRig
from bevcli.options import gather
from bevcli.sequences.native.tables import write_ego_motion
from bevcli.workshop.formats.native_writer import NativeWriter
from bevcli.workshop.synth.drive import RenderedDrive
from bevcli.workshop.synth.options import JPEG_QUALITY, RenderOptions
from bevcli.workshop.synth.rig import rig_for_rendering
from bevcli.workshop.synth.workers import shared_out

EGO_MOTION_HZ = 50.0
SUPERSAMPLED_WIDTH = 1000  # images up to this width are supersampled by default
THREADS = 2
NO_PIXELS = np.empty((0, 0, 3), np.uint8)


@dataclass(frozen=True)
class RenderSummary:
    """Summary of the sequence that `render` has written.

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
    options: RenderOptions | None = None,
    *,
    progress: Callable[[Frame], None] | None = None,
    **changes: Any,
) -> RenderSummary:
    """Render a drive through a procedural city and write it as a sequence with ground truth boxes and maps.

    The same options give the same files. The models of this project were trained on seeds below 1,000,000 only. The
    first call on a computer compiles the renderer, which takes about 15 s.

    Args:
        out: the sequence folder to write.
        options: the options; by default those of `RenderOptions`. With several `workers`, a program must call this
            function under `if __name__ == "__main__":`, because each of them imports the program.
        progress: called with each frame after it is written. With several `workers`, its images have no pixels.
        changes: options by name, such as `seed=7` and `resolution=(800, 450)`.

    Raises:
        InputError: an option is out of range, the calibration file is wrong, or a camera's field of view is too wide.
        OutputError: `out` contains a sequence and `force` is false, or it cannot be written.
    """
    chosen = gather(RenderOptions, options, changes)
    rig = rig_for_rendering(chosen.rig, chosen.resolution)
    drive = _drive_of(chosen, rig, THREADS)
    export = partial(export_drive, drive, Path(out), force=chosen.force, quality=chosen.quality, progress=progress)
    if chosen.workers == 1:
        export()
    else:
        with shared_out(partial(_frames_of, chosen, rig), chosen.frames, chosen.workers) as frames:
            export(frames=frames)
    return RenderSummary(Path(out), chosen.seed, chosen.frames, rig.names, drive.weather.name)


def _drive_of(chosen: RenderOptions, rig: CameraRig, threads: int) -> RenderedDrive:
    samples = chosen.supersampling or (2 if max(c.width for c in rig.cameras) <= SUPERSAMPLED_WIDTH else 1)
    return RenderedDrive(
        chosen.seed, chosen.frames, chosen.rate_hz, rig, chosen.weather, supersampling=samples, threads=threads
    )


def _frames_of(chosen: RenderOptions, rig: CameraRig, indices: Sequence[int]) -> Iterator[Frame]:
    """Some frames of the drive, for a process of its own. Their images have no pixels, only files."""
    drive = _drive_of(chosen, rig, threads=1)
    for frame in _encoded(drive, indices, chosen.quality):
        bare = {name: replace(image, pixels_bgr=NO_PIXELS) for name, image in frame.images.items()}
        yield replace(frame, images=bare)


def export_drive(
    drive: RenderedDrive,
    folder: Path,
    *,
    force: bool = False,
    quality: int = JPEG_QUALITY,
    progress: Callable[[Frame], None] | None = None,
    frames: Iterable[Frame] | None = None,
) -> None:
    """Render all frames of a drive and write them, with ego-motion at EGO_MOTION_HZ, ground truth boxes and maps.

    folder: the sequence folder. force: whether to replace a sequence in it. quality: JPEG quality, 1 to 100.
    progress: called with each frame after it is written. frames: those of the drive, if they are rendered elsewhere.
    Raises OutputError where the folder contains a sequence and `force` is false, or cannot be written.
    """
    with NativeWriter(folder, with_ego_motion=True, force=force, facts=DriveFacts(rendered=True)) as writer:
        for frame in _encoded(drive, range(drive.frames), quality) if frames is None else frames:
            writer.write(frame)
            if progress is not None:
                progress(frame)
    # The writer has written a pose for each frame. Replace them by denser ones, so that cameras may have time offsets.
    write_ego_motion(folder / "ego_motion.csv", drive.ego_motion(EGO_MOTION_HZ))


def _encoded(drive: RenderedDrive, indices: Sequence[int], quality: int) -> Iterator[Frame]:
    """Frames of the drive with image files."""
    motion = drive.ego_motion(EGO_MOTION_HZ)
    for index in indices:
        rendered = drive.frame(index)
        images = {
            name: CameraImage(rendered.camera_timestamps_ns[name], pixels, _encode_jpeg(pixels, quality), "image/jpeg")
            for name, pixels in rendered.images.items()
        }
        yield Frame(
            rendered.stamp, drive.rig, images, rendered.world_from_ego, rendered.world_from_ego_at,
            motion.kinematics_at(rendered.stamp.timestamp_ns), ground_truth=_rounded(rendered.boxes),
            ground_truth_map=rendered.bev_map, ground_truth_results=(rendered.lines,),
        )  # fmt: skip


def _encode_jpeg(pixels_bgr: NDArray[np.uint8], quality: int) -> bytes:
    """The bytes of a JPEG file."""
    return cv2.imencode(".jpg", pixels_bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def _rounded(boxes: Boxes3D) -> Boxes3D:
    """The boxes rounded to 0.1 mm and 10 microradians, which keeps the files small."""
    decimals = {"centers": 4, "sizes_lwh": 4, "yaws": 5, "velocities": 4, "visibilities": 4}
    values: dict[str, Any] = {name: getattr(boxes, name) for name in decimals}
    return replace(boxes, **{name: np.round(v, decimals[name]) for name, v in values.items() if v is not None})
