"""A rendered drive, written as a native sequence folder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.frame import CameraImage, Frame
from bevcli.geometry.boxes import Boxes3D
from bevcli.sequences.native.ego_motion_file import write_ego_motion
from bevcli.sequences.native.writer import NativeWriter
from bevcli.synth.drive import Drive, RenderedFrame

JPEG_QUALITY = 90
EGO_MOTION_HZ = 50.0


def export_drive(
    drive: Drive,
    folder: Path,
    *,
    force: bool = False,
    quality: int = JPEG_QUALITY,
    progress: Callable[[RenderedFrame], None] = lambda frame: None,
) -> None:
    """Render every frame of a drive into `folder`, with ego-motion at EGO_MOTION_HZ, ground truth boxes and maps.

    quality: of the JPEGs, 1 to 100. progress: called after each frame. Raises OutputError where the folder holds a
    sequence (but with `force`) or cannot be written.
    """
    motion = drive.ego_motion(EGO_MOTION_HZ)
    with NativeWriter(folder, with_ego_motion=True, force=force) as writer:
        for index in range(drive.frames):
            rendered = drive.frame(index)
            kinematics = motion.kinematics_at(rendered.stamp.timestamp_ns)
            images = {
                name: CameraImage(rendered.stamp.timestamp_ns, pixels, encode_jpeg(pixels, quality), "image/jpeg")
                for name, pixels in rendered.images.items()
            }
            writer.write(
                Frame(
                    rendered.stamp, drive.rig, images, rendered.world_from_ego,
                    dict.fromkeys(images, rendered.world_from_ego), kinematics,
                    ground_truth=rounded(rendered.boxes), ground_truth_map=rendered.bev_map,
                )
            )  # fmt: skip
            progress(rendered)
    write_ego_motion(
        folder / "ego_motion.csv", motion
    )  # denser than the frames, so that cameras may be shifted in time


def encode_jpeg(pixels_bgr: NDArray[np.uint8], quality: int = JPEG_QUALITY) -> bytes:
    """The bytes of a JPEG file."""
    return cv2.imencode(".jpg", pixels_bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def rounded(boxes: Boxes3D) -> Boxes3D:
    """The boxes with a tenth of a millimetre as their smallest digit, so that files stay small."""
    return replace(
        boxes,
        centers=np.round(boxes.centers, 4),
        sizes_lwh=np.round(boxes.sizes_lwh, 4),
        yaws=np.round(boxes.yaws, 5),
        velocities=np.round(boxes.velocities, 4),
        visibilities=None if boxes.visibilities is None else np.round(boxes.visibilities, 4),
    )
