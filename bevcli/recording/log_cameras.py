"""Writes one camera of a frame into a recording: pose, image, and the overlays of the image."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import rerun as rr

from bevcli.frame import CameraImage, CameraSamples
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array, apply, inverse
from bevcli.recording import entities
from bevcli.recording.box_lines import ImageLines, labels_2d, labels_in_image, lines_in_image
from bevcli.recording.colors import colormap
from bevcli.recording.video_images import Av1Encoder

JPEG_QUALITY = 85  # for images that have no encoded bytes, such as those of a video
POINT = rr.Radius.ui_points(2.0)


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

    @property
    def camera_from_world(self) -> Array:
        """(4, 4) from the recording's world."""
        return inverse(self.world_from_camera)


def transform(parent_from_entity: Array) -> rr.Transform3D:
    """The pose (4, 4) of an entity in its parent, for a recording."""
    return rr.Transform3D(translation=parent_from_entity[:3, 3], mat3x3=parent_from_entity[:3, :3])


def log_image(stream: rr.RecordingStream, posed: PosedCamera, image: CameraImage | None) -> None:
    """Writes the encoded image. Without an image, the one of the frame before is cleared."""
    if image is None:
        stream.log(entities.image(posed.name), rr.Clear(recursive=False))
        return
    contents, media_type = image.encoded, image.media_type
    if contents is None or media_type is None:
        _, data = cv2.imencode(".jpg", image.pixels_bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        contents, media_type = data.tobytes(), "image/jpeg"
    stream.log(entities.image(posed.name), rr.EncodedImage(contents=contents, media_type=media_type))


class VideoImages:
    """Writes the images of all cameras as AV1 video streams, one for each camera."""

    def __init__(self, stream: rr.RecordingStream) -> None:
        self._stream = stream
        self._encoders: dict[str, Av1Encoder] = {}

    def log(self, posed: PosedCamera, image: CameraImage | None) -> None:
        """Writes an image. A missing one is cleared, and the stream starts anew with the next."""
        entity, name = entities.image(posed.name), posed.name
        if image is None:
            self._stream.log(entity, rr.Clear(recursive=False))
            if name in self._encoders:
                self._encoders.pop(name).close()
            return
        if name not in self._encoders:
            height, width = image.pixels_bgr.shape[:2]
            self._encoders[name] = Av1Encoder(width, height)
        data, is_keyframe = self._encoders[name].encode(image.pixels_bgr)
        self._stream.log(entity, rr.VideoStream(codec=rr.VideoCodec.AV1, sample=data, is_keyframe=is_keyframe))

    def close(self) -> None:
        """Ends all streams."""
        for encoder in self._encoders.values():
            encoder.close()


def log_boxes_in_image(
    stream: rr.RecordingStream, posed: PosedCamera, boxes: Boxes3D, colors: np.ndarray, texts: list[str]
) -> None:
    """Draws predicted boxes (in the recording's world) into the image: lines and labels.

    colors: (N, 3) uint8. texts: the label of each box.
    """
    name = posed.name
    lines = lines_in_image(boxes, posed.camera, posed.camera_from_world)
    stream.log(entities.overlay(name, "boxes"), _strips(lines, colors, 1.0, draw_order=30))
    places, owners = labels_in_image(lines, texts, posed.camera.width, posed.camera.height)
    labels = labels_2d(places, [texts[owner] for owner in owners], colors=colors[owners], draw_order=31)
    stream.log(entities.overlay(name, "boxes/labels"), labels)


def log_ground_truth_in_image(
    stream: rr.RecordingStream, posed: PosedCamera, truth: Boxes3D, colors: np.ndarray
) -> None:
    """Draws ground-truth boxes (in the recording's world) into the image. colors: (M, 3) uint8."""
    lines = lines_in_image(truth, posed.camera, posed.camera_from_world)
    stream.log(entities.overlay(posed.name, "ground_truth"), _strips(lines, colors, 0.6, draw_order=20))


def _strips(lines: ImageLines, colors: np.ndarray, width: float, draw_order: int) -> rr.LineStrips2D:
    segments, radii = lines.segments.astype(np.float32), rr.Radius.ui_points(width)
    return rr.LineStrips2D(segments, colors=colors[lines.owners], radii=radii, draw_order=draw_order)


def log_pillar_hits(stream: rr.RecordingStream, posed: PosedCamera, points_world: Array, colors: np.ndarray) -> None:
    """Draws the projections of 3D reference points into the image, where they are inside of it.

    points_world: (K, 3) in the recording's world, metres. colors: (K, 3) uint8 RGB.
    """
    pixels, depth = posed.camera.project(apply(posed.camera_from_world, points_world))
    hits = posed.camera.contains(pixels, depth)
    points = rr.Points2D(pixels[hits], colors=colors[hits], radii=POINT, draw_order=10)
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
