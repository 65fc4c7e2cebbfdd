"""Writes the cameras of a frame into a recording: poses, images, boxes and other overlays of the images."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import rerun as rr
from numpy.typing import ArrayLike, NDArray

from bevcli.frame import CameraImage, CameraSamples
from bevcli.geometry.boxes import BOX_EDGES, Boxes2D, Boxes3D
from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array, apply
from bevcli.parsing.images import encode_image
from bevcli.recording import entities
from bevcli.recording.entities import Components, components, log, ui_points

if TYPE_CHECKING:
    from bevcli.recording.av1 import Av1Encoder

NEAR_CLIP_M = 0.2  # lines are cut at this depth; nearer points would project far outside of the image
PIECES_PER_EDGE = 8  # distortion bends edges; they are drawn as this many short lines
FRONT_EDGES = ((0, 7), (3, 4))  # the diagonals of the front face show the heading
_EDGES = np.array((*BOX_EDGES, *FRONT_EDGES))
LOWEST_LABELLED = 0.05  # of the image's height: smaller boxes are not labelled
# Of the image's width and height, for a view that is a third of the screen wide.
LETTER_WIDTH, LETTER_HEIGHT = 0.019, 0.085
OUT_OF_VIEW = "out of view"
UNSEEN = ui_points(0.01)  # of a point that shows only its label
JPEG_QUALITY = 85  # for images that have no encoded bytes, such as those of a video
POINT, THIN = ui_points(2.0), ui_points(0.5)
NO_COLORS = np.zeros((0, 3), np.uint8)


@dataclass(frozen=True)
class PosedCamera:
    """A camera with its pose at the time of its image."""

    camera: Camera  # name, intrinsics and distortion
    world_from_camera: Array  # (4, 4) into the recording's world
    camera_from_world: Array  # (4, 4), its inverse


@dataclass(frozen=True)
class ImageLayer:
    """Boxes that are drawn into the images."""

    kind: str  # of their overlay, see `bevcli.recording.entities.overlay`
    corners: Array  # (N, 8, 3) in the recording's world
    colors: NDArray[np.uint8]  # (N, 3) uint8
    texts: list[str] | None = None  # N labels; None for none
    width: float = 1.0  # of the lines, in points of the user interface
    order: int = 30  # boxes with a higher one are drawn above others


@dataclass(frozen=True)
class ImageLines:
    """Lines in an image."""

    segments: Array  # (M, 2, 2) start and end of each line, pixels, inside the image
    # (M,) the index of the box that each line belongs to; the lines of a box follow each other
    owners: NDArray[np.int64]


def lines_in_images(corners: Array, cameras: Sequence[PosedCamera]) -> list[ImageLines]:
    """The edges and the front diagonals of boxes in the images of C cameras, cut to the parts inside the images.

    corners: (N, 8, 3) of the boxes in the recording's world.
    """
    of_cameras = np.stack([apply(posed.camera_from_world, corners) for posed in cameras])  # (C, N, 8, 3)
    # A side of an undistorted image is a plane through the camera: boxes beyond it, by a pixel at least, are left out.
    intrinsics = np.stack([posed.camera.intrinsics[:2].T for posed in cameras])
    sizes = np.array([(posed.camera.width + 1, posed.camera.height + 1) for posed in cameras])[:, None, None]
    pixels, depth = of_cameras @ intrinsics[:, None], of_cameras[..., 2:]  # pixels times depth, (C, N, 8, 2)
    beside = (pixels < -depth).all(2) | (pixels > sizes * depth).all(2)  # (C, N, 2): left or right, above or below
    is_straight = np.array([posed.camera.distortion is None for posed in cameras])
    outside = beside.any(-1) & is_straight[:, None]
    camera, before = np.nonzero((depth[..., 0] >= NEAR_CLIP_M).any(-1) & ~outside)
    edges = of_cameras[camera, before][:, _EDGES]  # (K, 14, 2, 3)
    counts = np.bincount(camera, minlength=len(cameras)) * len(_EDGES)
    return cut_to_images(edges.reshape(-1, 2, 3), np.repeat(before, len(_EDGES)), counts, cameras)


def cut_to_images(
    ends: Array, owners: NDArray[np.int64], counts: NDArray[np.int64], cameras: Sequence[PosedCamera]
) -> list[ImageLines]:
    """The parts inside the images of lines (M, 2, 3) with their owners (M,).

    counts: (C,) how many of the lines, one camera after the other, are in the frame of each camera.
    """
    ends, kept = clip_near(ends)
    own_counts = np.bincount(np.repeat(np.arange(len(cameras)), counts)[kept], minlength=len(cameras))
    ends_of_cameras = np.cumsum(own_counts)[:-1]
    own_ends, own_owners = np.split(ends[kept], ends_of_cameras), np.split(owners[kept], ends_of_cameras)
    for i, posed in enumerate(cameras):
        if posed.camera.distortion is not None:
            own_ends[i], own_owners[i] = _cut(own_ends[i]), np.repeat(own_owners[i], PIECES_PER_EDGE)
    pixels = [posed.camera.project(ends)[0] for posed, ends in zip(cameras, own_ends, strict=True)]
    lengths = [len(points) for points in pixels]
    sizes = np.repeat([(posed.camera.width, posed.camera.height) for posed in cameras], lengths, axis=0)
    segments, inside = clip_to_image(np.concatenate(pixels), *sizes.T)
    ends_of_cameras = np.cumsum(lengths)[:-1]
    parts = zip(*(np.split(whole, ends_of_cameras) for whole in (segments, inside)), own_owners, strict=True)
    return [ImageLines(points[shown], owner[shown]) for points, shown, owner in parts]


def clip_near(ends: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Lines (M, 2, 3) in the camera frame, cut at depth NEAR_CLIP_M, and which of them (M,) reach beyond it."""
    depth = ends[..., 2]
    before = depth >= NEAR_CLIP_M
    span = depth[:, 1] - depth[:, 0]
    share = np.clip((NEAR_CLIP_M - depth[:, 0]) / np.where(span == 0, 1.0, span), 0, 1)
    cut = ends[:, 0] + share[:, None] * (ends[:, 1] - ends[:, 0])
    return np.where(before[..., None], ends, cut[:, None]), np.asarray(before.any(-1))


def clip_to_image(segments: Array, width: ArrayLike, height: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
    """Lines (M, 2, 2) in pixels, cut at the image's border, and which of them (M,) are inside (Liang and Barsky).

    A line whose start or end is NaN counts as outside. width, height: of the image, or (M,) of the image of each line.
    """
    start, step = segments[:, 0], segments[:, 1] - segments[:, 0]
    (x, y), (x_step, y_step) = start.T, step.T
    slope = np.stack([-x_step, -y_step, x_step, y_step])  # (4, M): against left, top, right, bottom
    room = np.stack([x, y, width - x, height - y])
    with np.errstate(divide="ignore", invalid="ignore"):
        share = room / slope
    enter = np.max(np.where(slope < 0, share, 0.0), axis=0, initial=0.0)
    leave = np.min(np.where(slope > 0, share, 1.0), axis=0, initial=1.0)
    outside = ((slope == 0) & (room < 0)).any(0)
    kept = (enter < leave) & ~outside & np.isfinite(slope).all(0) & np.isfinite(room).all(0)
    shares = np.stack([enter, leave], axis=-1)
    return start[:, None] + shares[..., None] * step[:, None], kept


def _cut(ends: Array) -> Array:
    shares = np.linspace(0, 1, PIECES_PER_EDGE + 1)[:, None]
    points = ends[:, None, 0] + shares * (ends[:, None, 1] - ends[:, None, 0])  # (M, pieces + 1, 3)
    return np.stack([points[:, :-1], points[:, 1:]], axis=2).reshape(-1, 2, 3)


def labels_2d(positions: ArrayLike, texts: list[str], **options: Any) -> Components:
    """Texts at positions (L, 2), in the units of their view. options: of `rr.Points2D`."""
    return components(
        rr.Points2D, positions=np.asarray(positions), labels=texts, radii=UNSEEN, show_labels=True, **options
    )


def box_labels(boxes: Boxes3D) -> list[str]:
    """The text of each label: "car 0.83", "car" where boxes have no scores, "car #12 0.83" for a box of track 12.

    One of a track that no camera sees now says so: "car #12 0.83 out of view".
    """
    texts = [str(name).replace("_", " ") for name in boxes.classes]
    if boxes.instances is not None:
        texts = [f"{text} #{track}" if track else text for text, track in zip(texts, boxes.instances, strict=True)]
    if boxes.scores is not None:
        texts = [f"{text} {score:.2f}" for text, score in zip(texts, boxes.scores, strict=True)]
    if boxes.unseen is not None:
        texts = [f"{text} {OUT_OF_VIEW}" if unseen else text for text, unseen in zip(texts, boxes.unseen, strict=True)]
    return texts


def labels_in_image(lines: ImageLines, texts: list[str], width: int, height: int) -> tuple[Array, NDArray[np.int64]]:
    """Positions of labels above their boxes. The largest boxes are labelled first; no label covers another.

    lines: the boxes' lines in an image of this width and height. texts: the label of each box.

    Returns the centres of the labels (L, 2), pixels, and the boxes (L,) that they belong to.
    """
    boxes, first = np.unique(lines.owners, return_index=True)  # the lines of a box follow each other
    ends = lines.segments.reshape(-1, 2)
    lows = np.minimum.reduceat(ends, 2 * first).tolist() if len(first) else ()
    highs = np.maximum.reduceat(ends, 2 * first).tolist() if len(first) else ()
    rectangles = zip(boxes.tolist(), lows, highs, strict=True)
    taken: list[tuple[float, float, float, float]] = []
    centers, owners = [], []
    for owner, low, high in sorted(rectangles, key=lambda item: item[1][1] - item[2][1]):
        if high[1] - low[1] < LOWEST_LABELLED * height:
            break
        half = len(texts[owner]) * LETTER_WIDTH * width / 2
        middle = min(max((low[0] + high[0]) / 2, half), width - half)
        left, top, right, bottom = middle - half, low[1] - LETTER_HEIGHT * height, middle + half, low[1]
        if not any(left < other[2] and other[0] < right and top < other[3] and other[1] < bottom for other in taken):
            taken.append((left, top, right, bottom))
            centers.append((middle, low[1] - LETTER_HEIGHT * height / 2))
            owners.append(owner)
    return np.array(centers).reshape(-1, 2), np.array(owners, dtype=np.int64)


def transform(parent_from_entity: Array) -> Components:
    """The pose (4, 4) of an entity in its parent, for a recording."""
    columns = parent_from_entity[:3, :3].T
    return components(rr.Transform3D, translation=parent_from_entity[:3, 3], mat3x3=columns)


@dataclass
class CameraImages:
    """Writes the images of all cameras."""

    stream: rr.RecordingStream
    as_video: bool  # AV1, in place of the bytes of the image files
    without: list[str]  # the cameras whose last frame had no image
    encoders: "dict[str, Av1Encoder]" = field(default_factory=dict)

    def log(self, camera: Camera, image: CameraImage | None) -> None:
        """Writes an image. Without one that of the frame before goes, and a text says so."""
        name, text = camera.name, entities.overlay(camera.name, entities.NO_IMAGE)
        if image is not None:
            self._log_image(name, image)
            if name in self.without:
                self.without.remove(name)
                self.stream.log(text, rr.Clear(recursive=False))
        elif name not in self.without:
            self.without.append(name)
            # The viewer goes on to show an encoded image that is cleared as other entities are.
            cleared = rr.Clear(recursive=False) if self.as_video else rr.EncodedImage.cleared()
            self.stream.log(entities.image(name), cleared)
            if name in self.encoders:  # a video starts anew with the next image
                self.encoders.pop(name).close()
            middle = camera.width / 2, camera.height / 2
            label = labels_2d([middle], [f"{name}: no image"], colors=entities.MISSED_COLOR, draw_order=50)
            log(self.stream, text, label)

    def _log_image(self, camera: str, image: CameraImage) -> None:
        entity = entities.image(camera)
        if self.as_video:
            if camera not in self.encoders:
                from bevcli.recording.av1 import Av1Encoder  # needs PyAV

                height, width = image.pixels_bgr.shape[:2]
                self.encoders[camera] = Av1Encoder(width, height)
            data, is_keyframe = self.encoders[camera].encode(image.pixels_bgr)
            self.stream.log(entity, rr.VideoStream(codec=rr.VideoCodec.AV1, sample=data, is_keyframe=is_keyframe))
        else:
            contents, media_type = image.encoded, image.media_type
            if contents is None or media_type is None:
                contents, media_type = encode_image(image.pixels_bgr, quality=JPEG_QUALITY), "image/jpeg"
            file = np.frombuffer(contents, np.uint8)
            log(self.stream, entity, components(rr.EncodedImage, blob=file, media_type=media_type))


def log_boxes_in_images(
    stream: rr.RecordingStream, cameras: Sequence[PosedCamera], layers: Sequence[ImageLayer]
) -> None:
    """Draws boxes, and the labels of those that have some, into the images. Layers with labels come first."""
    corners, colors = (np.concatenate([getattr(layer, name) for layer in layers]) for name in ("corners", "colors"))
    texts = [text for layer in layers for text in layer.texts or ()]
    starts = np.cumsum([0, *(len(layer.corners) for layer in layers)])
    for posed, lines in zip(cameras, lines_in_images(corners, cameras), strict=True):
        camera, ends = posed.camera, np.searchsorted(lines.owners, starts).tolist()
        labelled = int(np.searchsorted(lines.owners, len(texts)))
        predicted = ImageLines(lines.segments[:labelled], lines.owners[:labelled])
        positions, owners = labels_in_image(predicted, texts, camera.width, camera.height)
        for i, layer in enumerate(layers):
            rows, entity = slice(ends[i], ends[i + 1]), entities.overlay(camera.name, layer.kind)
            segments, line_colors, radii = lines.segments[rows], colors[lines.owners[rows]], ui_points(layer.width)
            strips = components(
                rr.LineStrips2D, strips=segments, colors=line_colors, radii=radii, draw_order=layer.order
            )
            log(stream, entity, strips)
            if layer.texts is not None:
                selection = (owners >= starts[i]) & (owners < starts[i + 1])
                names, label_colors = [texts[owner] for owner in owners[selection]], colors[owners[selection]]
                labels = labels_2d(positions[selection], names, colors=label_colors, draw_order=layer.order + 1)
                log(stream, f"{entity}/labels", labels)


def log_image_boxes(
    stream: rr.RecordingStream,
    cameras: Sequence[PosedCamera],
    boxes: Mapping[str, Boxes2D],
    colors: Mapping[str, NDArray[np.uint8]],
) -> None:
    """Draws boxes in images as thin rectangles. boxes, and their colours (N, 3): by camera."""
    for posed in cameras:
        name = posed.camera.name
        strips = boxes[name].outlines() if name in boxes else np.zeros((0, 5, 2))
        row = components(rr.LineStrips2D, strips=strips, colors=colors.get(name, NO_COLORS), radii=THIN, draw_order=15)
        log(stream, entities.overlay(name, entities.IMAGE_BOXES), row)


def log_pillar_hits(stream: rr.RecordingStream, posed: PosedCamera, points_world: Array, colors: np.ndarray) -> None:
    """Draws the projections of 3D reference points into the image, where they are inside of it.

    points_world: (K, 3) in the recording's world, metres. colors: (K,) of `packed`.
    """
    points = apply(posed.camera_from_world, points_world)
    ahead = points[:, 2] > 0
    pixels, depth = posed.camera.project(points[ahead])
    hits = posed.camera.contains(pixels, depth)
    row = components(rr.Points2D, positions=pixels[hits], colors=colors[ahead][hits], radii=POINT, draw_order=10)
    log(stream, entities.overlay(posed.camera.name, "pillars"), row)


def log_samples(stream: rr.RecordingStream, posed: PosedCamera, samples: Sequence[CameraSamples]) -> None:
    """Draws the sampling points of spatial cross-attention in this image: larger and brighter with their weight."""
    pixels = np.concatenate([np.zeros((0, 2)), *(s.pixels for s in samples)])
    weights = np.concatenate([np.zeros(0), *(s.weights for s in samples)])
    inside = posed.camera.contains(pixels, np.ones(len(pixels)))
    shares = weights[inside] / max(float(weights.max(initial=0.0)), 1e-9)
    colors, radii = entities.colormap(0.25 + 0.75 * shares, "plasma"), rr.Radius.ui_points(1.5 + 5.0 * np.sqrt(shares))
    points = rr.Points2D(pixels[inside], colors=colors, radii=radii, draw_order=40)
    stream.log(entities.overlay(posed.camera.name, "probes"), points)
