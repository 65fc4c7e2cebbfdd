"""Writes one camera of a frame into a recording: pose, image, and the overlays of the image."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import rerun as rr

from bevcli.frame import CameraImage, CameraSamples
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array, apply, inverse
from bevcli.recording import entities
from bevcli.recording.box_lines import ImageLines, labels_2d, labels_in_image, lines_in_images
from bevcli.recording.colors import colormap
from bevcli.recording.components import Components, blob, components, ui_points
from bevcli.recording.video_images import Av1Encoder

JPEG_QUALITY = 85  # for images that have no encoded bytes, such as those of a video
POINT = ui_points(2.0)


@dataclass(frozen=True)
class PosedCamera:
    """A camera with its pose at the time of its image.

    Attributes:
        camera: name, intrinsics and distortion.
        world_from_camera: (4, 4) into the recording's world.
    """

    camera: Camera
    world_from_camera: Array

    @property
    def name(self) -> str:
        """The camera's name."""
        return self.camera.name

    @cached_property
    def camera_from_world(self) -> Array:
        """(4, 4) from the recording's world."""
        return inverse(self.world_from_camera)


def transform(parent_from_entity: Array) -> Components:
    """The pose (4, 4) of an entity in its parent, for a recording."""
    columns = parent_from_entity[:3, :3].T
    return components(rr.Transform3D, translation=parent_from_entity[:3, 3], mat3x3=columns)


class CameraImages:
    """Writes the images of all cameras. as_video: AV1, in place of the bytes of the image files."""

    def __init__(self, stream: rr.RecordingStream, *, as_video: bool) -> None:
        self._stream, self._as_video = stream, as_video
        self._encoders: dict[str, Av1Encoder] = {}

    def log(self, camera: str, image: CameraImage | None) -> None:
        """Writes an image. Without one, that of the frame before is cleared, and a video starts anew with the next."""
        if image is not None:
            written = self._video_image(camera, image) if self._as_video else _encoded(image)
            self._stream.log(entities.image(camera), written)
            return
        self._stream.log(entities.image(camera), rr.Clear(recursive=False))
        if camera in self._encoders:
            self._encoders.pop(camera).close()

    def _video_image(self, camera: str, image: CameraImage) -> rr.VideoStream:
        if camera not in self._encoders:
            height, width = image.pixels_bgr.shape[:2]
            self._encoders[camera] = Av1Encoder(width, height)
        data, is_keyframe = self._encoders[camera].encode(image.pixels_bgr)
        return rr.VideoStream(codec=rr.VideoCodec.AV1, sample=data, is_keyframe=is_keyframe)

    def close(self) -> None:
        """Ends all video streams."""
        for encoder in self._encoders.values():
            encoder.close()


def _encoded(image: CameraImage) -> Components:
    contents, media_type = image.encoded, image.media_type
    if contents is None or media_type is None:
        _, data = cv2.imencode(".jpg", image.pixels_bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        contents, media_type = data.tobytes(), "image/jpeg"
    return components(rr.EncodedImage, blob=blob(contents), media_type=media_type)


def log_boxes_in_images(
    stream: rr.RecordingStream, cameras: Sequence[PosedCamera], boxes: Boxes3D, colors: np.ndarray, texts: list[str]
) -> None:
    """Draws predicted boxes (in the recording's world) into the images: lines and labels.

    colors: (N, 3) uint8. texts: the label of each box.
    """
    for posed, lines in zip(cameras, _lines_of(boxes, cameras), strict=True):
        stream.log(entities.overlay(posed.name, "boxes"), _strips(lines, colors, 1.0, draw_order=30))
        places, owners = labels_in_image(lines, texts, posed.camera.width, posed.camera.height)
        labels = labels_2d(places, [texts[owner] for owner in owners], colors=colors[owners], draw_order=31)
        stream.log(entities.overlay(posed.name, "boxes/labels"), labels)


def log_ground_truth_in_images(
    stream: rr.RecordingStream, cameras: Sequence[PosedCamera], truth: Boxes3D, colors: np.ndarray
) -> None:
    """Draws ground-truth boxes (in the recording's world) into the images. colors: (M, 3) uint8."""
    for posed, lines in zip(cameras, _lines_of(truth, cameras), strict=True):
        stream.log(entities.overlay(posed.name, "ground_truth"), _strips(lines, colors, 0.6, draw_order=20))


def _lines_of(boxes: Boxes3D, cameras: Sequence[PosedCamera]) -> list[ImageLines]:
    return lines_in_images(boxes, [one.camera for one in cameras], [one.camera_from_world for one in cameras])


def _strips(lines: ImageLines, colors: np.ndarray, width: float, draw_order: int) -> Components:
    own, radii = colors[lines.owners], ui_points(width)
    return components(rr.LineStrips2D, strips=lines.segments, colors=own, radii=radii, draw_order=draw_order)


def log_pillar_hits(stream: rr.RecordingStream, posed: PosedCamera, points_world: Array, colors: np.ndarray) -> None:
    """Draws the projections of 3D reference points into the image, where they are inside of it.

    points_world: (K, 3) in the recording's world, metres. colors: (K,) of `packed`.
    """
    pixels, depth = posed.camera.project(apply(posed.camera_from_world, points_world))
    hits = posed.camera.contains(pixels, depth)
    points = components(rr.Points2D, positions=pixels[hits], colors=colors[hits], radii=POINT, draw_order=10)
    stream.log(entities.overlay(posed.name, "pillars"), points)


def log_samples(stream: rr.RecordingStream, posed: PosedCamera, samples: Sequence[CameraSamples]) -> None:
    """Draws the sampling points of spatial cross-attention in this image: larger and brighter with their weight."""
    pixels = np.concatenate([np.zeros((0, 2)), *(s.pixels for s in samples)])
    weights = np.concatenate([np.zeros(0), *(s.weights for s in samples)])
    inside = posed.camera.contains(pixels, np.ones(len(pixels)))
    shares = weights[inside] / max(float(weights.max(initial=0.0)), 1e-9)
    colors, radii = colormap(0.25 + 0.75 * shares, "plasma"), rr.Radius.ui_points(1.5 + 5.0 * np.sqrt(shares))
    points = rr.Points2D(pixels[inside], colors=colors, radii=radii, draw_order=40)
    stream.log(entities.overlay(posed.name, "probes"), points)
