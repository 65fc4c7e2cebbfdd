"""Writes a video of a recording: all cameras with their boxes, the BEV to the right, a legend below; or images alone.

H.264 in MP4, which plays everywhere, if PyAV is installed; VP9 else and in WebM.
"""

import errno
import math
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from functools import partial
from itertools import chain
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bevcli.errors import InputError
from bevcli.frame import MAP_CLASSES
from bevcli.geometry.object_classes import NUSCENES_CLASSES, ObjectClass, color_of_hex
from bevcli.geometry.transforms import Array
from bevcli.parsing.files import plain_name
from bevcli.parsing.images import decode_image
from bevcli.recording import entities, has_av, require_av
from bevcli.recording.blueprint import rows_by_yaw
from bevcli.recording.entities import Color, class_colors, map_colors
from bevcli.viewer import VideoView
from bevcli.viewer.drawing import Canvas, draw_lines
from bevcli.viewer.recording_file import open_recording
from bevcli.viewer.recording_reader import RecordedFrame, RecordingReader
from bevcli.workshop import plot
from bevcli.workshop.plot import Tile, ToCanvas
from bevcli.writing import whole_file

if has_av():
    import av

MOST_PIXELS = 64 << 20
STRIPS = "LineStrips2D:strips"
OPACITIES = 10  # steps of opacity, faint to opaque
BEV_RANGE_M = 50.0  # from the vehicle to each edge of the BEV view, in recordings without range rings
BELOW_BOXES = (
    entities.BEV_GROUND_TRUTH, entities.BEV_MISSED, entities.BEV_TRACKS, entities.BEV_FALSE, entities.BEV_DUPLICATES
)  # fmt: skip
FOURCC = {".mp4": "vp09", ".webm": "VP90"}  # VP9: OpenCV's wheels cannot write H.264
H264_QUALITY = 21  # x264's crf
SLOWEST, FASTEST = 1.0, 30.0  # frames a second


class Av1Decoder:
    """Decodes the images that an `Av1Encoder` made, in order, by PyAV, an optional package."""

    def __init__(self) -> None:
        self._context = av.CodecContext.create("libdav1d", "r")
        self._context.options = {"max_frame_delay": "1", "threads": "1"}

    def decode(self, data: bytes) -> NDArray[np.uint8] | None:
        """The next image, (H, W, 3) uint8 BGR; None before the first keyframe and for damaged data."""
        assert isinstance(self._context, av.VideoCodecContext)
        try:
            images = self._context.decode(av.Packet(data))
        except av.FFmpegError:
            return None
        return images[-1].to_ndarray(format="bgr24").astype(np.uint8, copy=False) if images else None


class RecordedImages:
    """The images of a recording: call `image` once for each camera of each frame, in order."""

    def __init__(self) -> None:
        self._decoders: dict[str, Av1Decoder] = {}

    def image(self, frame: RecordedFrame, camera: str) -> NDArray[np.uint8] | None:
        """The image of a camera, (H, W, 3) uint8 BGR; None if the frame has none. Raises BevcliError without PyAV."""
        entity = entities.image(camera)
        data = frame.blob(entity, "VideoStream:sample")
        if data:
            if camera not in self._decoders:
                require_av("the images of this recording are AV1")
                self._decoders[camera] = Av1Decoder()
            return self._decoders[camera].decode(data)
        encoded = frame.blob(entity, "EncodedImage:blob")
        image = decode_image(encoded, cv2.IMREAD_COLOR, MOST_PIXELS) if encoded else None
        return None if image is None else image.astype(np.uint8, copy=False)


def draw_strips(canvas: Canvas, frame: RecordedFrame, entity: str, to_canvas: ToCanvas, thickness: int = 1) -> None:
    """Draws the line strips of an entity, opaque."""
    strips = frame.strips(entity, STRIPS)
    colors = entity_colors(frame, entity, "LineStrips2D:colors", len(strips))
    for strip, color in zip(strips, colors, strict=True):
        draw_lines(canvas, [to_canvas(strip)], color, thickness)


def draw_faded_strips(canvas: Canvas, frame: RecordedFrame, entity: str, to_canvas: ToCanvas) -> None:
    """Draws the line strips of an entity with the opacity of their colours, in OPACITIES steps."""
    strips = frame.strips(entity, STRIPS)
    colors = entity_colors(frame, entity, "LineStrips2D:colors", len(strips))
    packed = np.array(frame.integers(entity, "LineStrips2D:colors") or [255])
    opacity = np.broadcast_to(packed if len(packed) == len(strips) else packed[:1], len(strips)) & 255
    step = np.ceil(opacity / 255 * OPACITIES).astype(int)
    for level in np.unique(step[step > 0]):
        below = canvas.copy()
        for index in np.flatnonzero(step == level):
            draw_lines(canvas, [to_canvas(strips[index])], colors[index])
        canvas[:] = cv2.addWeighted(canvas, level / OPACITIES, below, 1 - level / OPACITIES, 0)


def draw_arrows(canvas: Canvas, frame: RecordedFrame, entity: str, to_canvas: ToCanvas) -> None:
    """Draws the 2D arrows of an entity."""
    starts = frame.array(entity, "Arrows2D:origins", 2)
    ends = starts + frame.array(entity, "Arrows2D:vectors", 2, len(starts))
    colors = entity_colors(frame, entity, "Arrows2D:colors", len(starts))
    for start, end, color in zip(to_canvas(starts), to_canvas(ends), colors, strict=True):
        plot.draw_arrow(canvas, start, end, color)


def draw_labels(canvas: Canvas, frame: RecordedFrame, entity: str, to_canvas: ToCanvas, size: float = 0.4) -> None:
    """Draws the labels of an entity as text on a dark background, centred on the labelled points."""
    positions = to_canvas(frame.array(entity, "Points2D:positions", 2))
    colors = entity_colors(frame, entity, "Points2D:colors", len(positions))
    for text, (x, y), color in zip(frame.texts(entity, "Points2D:labels"), positions, colors, strict=False):
        plot.draw_text(canvas, text, (int(x), int(y)), color, size, centered=True)


def entity_colors(frame: RecordedFrame, entity: str, component: str, count: int) -> list[tuple[int, int, int]]:
    """`count` colours, BGR. One recorded colour is repeated; without a recorded colour all are white."""
    packed = frame.integers(entity, component) or [0xFFFFFFFF]
    colors = [((c >> 8) & 255, (c >> 16) & 255, (c >> 24) & 255) for c in packed]
    return colors if len(colors) == count else colors[:1] * count


def recorded_image(frame: RecordedFrame, entity: str) -> Canvas | None:
    """The uncompressed image of an entity, (H, W, 3) uint8 BGR; None if it has none."""
    formats = frame.values(entity, "Image:format")
    if not formats:
        return None
    pixels = np.frombuffer(frame.blob(entity, "Image:buffer"), dtype=np.uint8)
    layout = formats[0] if isinstance(formats[0], dict) else {}
    shape = (*(size if isinstance(size := layout.get(key), int) else 0 for key in ("height", "width")), 3)
    if pixels.size != math.prod(shape) or not pixels.size:
        raise frame.wrong(entity, "Image:buffer", f"{shape[1]} x {shape[0]} pixels RGB", f"{pixels.size} bytes")
    return pixels.reshape(shape)[..., ::-1]


def tiles(frame: RecordedFrame) -> tuple[Tile, ...]:
    """The rectangles of the cameras of a recording, in rows in the same order as in the viewer."""
    sizes = {name: _camera_size(frame, name) for name in frame.texts(entities.RUN, "camera_names")}
    if not sizes:
        raise frame.wrong(entities.RUN, "camera_names", "the names of cameras", "none")
    return plot.tiles_of(sizes, _camera_yaws(frame))


def _camera_size(frame: RecordedFrame, camera: str) -> Array:
    (size,) = frame.array(entities.camera(camera), "Pinhole:resolution", 2, 1)  # width, height, pixels
    if (size < 1).any():
        raise frame.wrong(entities.camera(camera), "Pinhole:resolution", "sizes above 0", size)
    return size


def _camera_yaws(frame: RecordedFrame) -> dict[str, float]:
    from_world = _rotation(frame, entities.EGO).T
    yaws = {}
    for name in frame.texts(entities.RUN, "camera_names"):
        ahead = from_world @ _rotation(frame, entities.camera(name))[:, 2]
        yaws[name] = float(np.arctan2(ahead[1], ahead[0]))
    return yaws


def draw_frame(frame: RecordedFrame, layout: tuple[Tile, ...], images: RecordedImages) -> Canvas:
    """The video frame with all cameras and the BEV, the sheet of `new_sheet`, uint8 BGR.

    layout: where each camera's image goes. images: decodes them; frames must come in order.
    """
    canvas = plot.new_sheet()
    for tile in layout:
        image = images.image(frame, tile.camera)
        _draw_camera(canvas[tile.top : tile.top + tile.height, tile.left : tile.left + tile.width], frame, tile, image)
    _draw_bev(canvas[:, plot.CAMERAS_WIDTH :], frame)
    _draw_legend(canvas[plot.CAMERAS_HEIGHT :, : plot.CAMERAS_WIDTH], frame)
    return canvas


def image_tiles(frame: RecordedFrame) -> tuple[Tile, ...]:
    """The rectangles of all cameras at the size of their images, side by side; those that look back are below."""
    sizes = {name: _camera_size(frame, name).astype(int) for name in frame.texts(entities.RUN, "camera_names")}
    tiles, top = list[Tile](), 0
    for row in rows_by_yaw(_camera_yaws(frame)):
        left = 0
        for name in row:
            tiles.append(Tile(name, left, top, *sizes[name].tolist()))
            left += tiles[-1].width
        top += max(tile.height for tile in tiles if tile.top == top)
    return tuple(tiles)


def draw_images(frame: RecordedFrame, layout: tuple[Tile, ...], images: RecordedImages) -> Canvas:
    """The images of a frame at their own size, with the boxes: (H, W, 3) uint8 BGR, H and W even, as videos need."""
    width, height = (max(end) for end in zip(*((t.left + t.width, t.top + t.height) for t in layout), strict=True))
    canvas = np.full((height + height % 2, width + width % 2, 3), plot.BACKGROUND, dtype=np.uint8)
    for tile in layout:
        part = canvas[tile.top : tile.top + tile.height, tile.left : tile.left + tile.width]
        image = images.image(frame, tile.camera)
        if image is None:
            plot.draw_title(part, tile.camera, has_image=False)
            continue
        part[:] = image[: tile.height, : tile.width]
        camera, size = entities.camera(tile.camera), max(plot.SMALL_TEXT, tile.width * plot.LABEL_SHARE)
        boxes = [entities.overlay(tile.camera, "boxes"), *(entities.layer(camera, name) for name in _layers(frame))]
        draw_strips(part, frame, entities.overlay(tile.camera, entities.IMAGE_BOXES), np.asarray)
        for entity in boxes:
            draw_strips(part, frame, entity, np.asarray, 1 + tile.width // 800)
        for entity in boxes:  # all of a label is in the image
            draw_labels(part, frame, f"{entity}/labels", partial(np.maximum, 16 * size), size)
    return canvas


def _draw_camera(canvas: Canvas, frame: RecordedFrame, tile: Tile, image: Canvas | None) -> None:
    width, height = _camera_size(frame, tile.camera)
    if image is not None:
        canvas[:] = cv2.resize(image, (tile.width, tile.height), interpolation=cv2.INTER_AREA)
    scale = np.array([tile.width / width, tile.height / height])

    def to_canvas(points: Array) -> Array:
        return np.clip(points * scale, -plot.FAR, plot.FAR)

    boxes = entities.overlay(tile.camera, "boxes")
    for line_kind in entities.line_kinds(frame.rows):
        draw_faded_strips(canvas, frame, entities.overlay(tile.camera, line_kind), to_canvas)
    draw_strips(canvas, frame, entities.overlay(tile.camera, entities.IMAGE_BOXES), to_canvas)
    draw_strips(canvas, frame, entities.overlay(tile.camera, "ground_truth"), to_canvas)
    layers = [entities.layer(entities.camera(tile.camera), name) for name in _layers(frame)]
    for entity in (boxes, *layers):
        draw_strips(canvas, frame, entity, to_canvas)
    for entity in (boxes, *layers):
        draw_labels(canvas, frame, f"{entity}/labels", to_canvas, plot.SMALL_TEXT)
    plot.draw_title(canvas, tile.camera, has_image=image is not None)


def _draw_bev(canvas: Canvas, frame: RecordedFrame) -> None:
    rings = max((np.abs(ring).max(initial=0) for ring in frame.strips(entities.BEV_RINGS, STRIPS)), default=0)
    to_canvas = plot.from_above(plot.BEV_MARGIN * rings or BEV_RANGE_M)

    segmentation = recorded_image(frame, entities.BEV_SEGMENTATION)
    if segmentation is not None:
        _draw_placed(canvas, frame, entities.BEV_SEGMENTATION, segmentation, to_canvas)
    draw_strips(canvas, frame, entities.BEV_RINGS, to_canvas)
    draw_labels(canvas, frame, f"{entities.BEV_RINGS}/labels", to_canvas, 0.35)
    for line_kind in entities.line_kinds(frame.rows):
        draw_faded_strips(canvas, frame, f"{entities.BEV}/{line_kind}", to_canvas)
    for entity in BELOW_BOXES:
        draw_strips(canvas, frame, entity, to_canvas)
    for entity in (entities.BEV_BOXES, *(entities.layer(entities.BEV, name) for name in _layers(frame))):
        draw_strips(canvas, frame, entity, to_canvas, 2)
    draw_arrows(canvas, frame, entities.BEV_VELOCITY, to_canvas)
    draw_strips(canvas, frame, entities.BEV_VEHICLE, to_canvas, 2)


def _draw_placed(canvas: Canvas, frame: RecordedFrame, entity: str, image: Canvas, to_canvas: ToCanvas) -> None:
    start = frame.array(entity, "Transform3D:translation", 3, 1)[0, :2]
    extent = frame.array(entity, "Transform3D:scale", 3, 1)[0, :2] * image.shape[1::-1]
    left, top = to_canvas(start).astype(int)
    right, bottom = to_canvas(start + extent).astype(int)
    x0, y0, x1, y1 = max(left, 0), max(top, 0), min(right, plot.BEV_SIDE), min(bottom, plot.BEV_SIDE)
    rows = (np.arange(y0, y1) - top) * image.shape[0] // max(1, bottom - top)
    columns = (np.arange(x0, x1) - left) * image.shape[1] // max(1, right - left)
    canvas[y0:y1, x0:x1] = image[rows[:, None], columns]


def _draw_legend(canvas: Canvas, frame: RecordedFrame) -> None:
    title = "".join(frame.texts(entities.RUN, "title"))
    scene = "".join(frame.texts(entities.EGO, "scene"))
    speed = "".join(frame.texts(entities.SPEED, "Points3D:labels"))
    plot.draw_text(canvas, f"{title}   {scene}   frame {frame.index}   {speed}", (16, 24), plot.TEXT, 0.6)
    note = "".join(frame.texts(entities.RUN, "note"))
    if any(frame.integers(entities.RUN, "untrained")):
        note = plot.UNTRAINED
    plot.draw_text(canvas, note, (plot.CAMERAS_WIDTH - 480, 24), plot.WARNING, 0.6)
    counts, layers = Counter(frame.texts(entities.BOXES, "name")), _layers(frame)
    for name in layers:
        counts[name] = len(frame.texts(entities.layer(entities.WORLD, name), "name"))
    for index, (name, color) in enumerate((layers or _class_colors(frame)).items()):
        position = 16 + 250 * (index % 5), 60 + 32 * (index // 5)
        plot.draw_entry(canvas, position, color, f"{name.replace('_', ' ')} {counts[name]}")
    for index, (name, color) in enumerate(_named_colors(frame, "line_names", "line_colors").items()):
        plot.draw_entry(canvas, (16 + 250 * index, 60 + 32 * 2), color, name)
    if frame.has(entities.BEV_SEGMENTATION, "Image:buffer"):
        # Recordings of version 0.1.0 do not name their classes, which are those of the segmentation head.
        classes = frame.texts(entities.RUN, "map_classes") or list(MAP_CLASSES)
        width = min(250, (plot.CAMERAS_WIDTH - 16) // len(classes))
        for index, (name, color) in enumerate(map_colors(classes).items()):
            plot.draw_entry(canvas, (16 + width * index, 60 + 32 * 2), color, f"map: {name.replace('_', ' ')}")


def _layers(frame: RecordedFrame) -> dict[str, Color]:
    """The names of two models that are compared, and their colours."""
    return _named_colors(frame, "layer_names", "layer_colors")


def _class_colors(frame: RecordedFrame) -> dict[str, Color]:
    """The colours of the model's classes. Recordings of version 0.1.0 name the classes only."""
    if not frame.has(entities.RUN, "class_colors"):
        names = frame.texts(entities.RUN, "class_names")
        return class_colors(NUSCENES_CLASSES.get(name, ObjectClass(name)) for name in names)
    return _named_colors(frame, "class_names", "class_colors")


def _named_colors(frame: RecordedFrame, names: str, colors: str) -> dict[str, Color]:
    """The colours that the recording states, by name."""
    keys = frame.texts(entities.RUN, names)
    values = frame.texts(entities.RUN, colors, len(keys))
    try:
        return {name: color_of_hex(color) for name, color in zip(keys, values, strict=True)}
    except ValueError:
        raise frame.wrong(entities.RUN, colors, "colours such as #ff9e2c", values) from None


def _rotation(frame: RecordedFrame, entity: str) -> Array:
    columns = frame.array(entity, "Transform3D:mat3x3", 9)
    return columns[0].reshape(3, 3).T if len(columns) else np.eye(3)  # rerun stores matrices by columns


def video(recording: str | Path, video: str | Path, view: VideoView = "all") -> tuple[int, float]:
    """Write a video of a recording; return its frames, and those a second.

        bevcli.video("street.rrd", "street.mp4")

    H.264 if PyAV is installed (`bevcli[video]`), else VP9.

    Args:
        recording: a recording, or the folder of a run.
        video: the .mp4 or .webm file to write.
        view: "all" for all cameras and the map from above, "images" for the images with the boxes and nothing else, at
            their own size and rate.

    Raises:
        InputError: there is no such recording, it has no frames, or the video has another ending.
        OutputError: the video cannot be written.
    """
    with open_recording(Path(recording)) as file:
        count, rate = frame_rate(file, view)
        for _ in write_video(file, Path(video), count, rate, view):
            pass
    return count, rate


def write_video(recording: Path, video: Path, count: int, rate: float, view: VideoView = "all") -> Iterator[int]:
    """Write the video, and yield after each frame. count, rate: of `frame_rate`. Raises as `video`."""
    if video.suffix.lower() not in FOURCC:
        raise InputError(f"{video}: the file must end in .mp4 or .webm")
    if not count:
        raise InputError(f"{recording}: the recording has no frames")
    encoder = _h264 if video.suffix.lower() == ".mp4" and has_av() else _vp9
    with whole_file(video) as whole, plain_name(whole) as unfinished:
        images = _images(recording, view)
        first = next(images)
        with encoder(unfinished, rate, (first.shape[1], first.shape[0])) as write:
            for index, image in enumerate(chain([first], images)):
                write(image)
                yield index
        capture = cv2.VideoCapture(unfinished)
        frames = capture.get(cv2.CAP_PROP_FRAME_COUNT) if capture.isOpened() else -1  # of a WebM, from the times
        if frames < max(count - 1, 0):  # OpenCV does not tell that a disk is full
            raise OSError(errno.ENOSPC, "not all frames are in the file: is the disk full?")


@contextmanager
def _vp9(video: str, rate: float, size: tuple[int, int]) -> Iterator[Callable[[np.ndarray], object]]:
    writer = cv2.VideoWriter(video, cv2.VideoWriter.fourcc(*FOURCC[Path(video).suffix.lower()]), rate, size)
    if not writer.isOpened():
        raise OSError("OpenCV cannot open it: is its folder there and writable, and is there enough memory?")
    try:
        yield writer.write
    finally:
        writer.release()


@contextmanager
def _h264(video: str, rate: float, size: tuple[int, int]) -> Iterator[Callable[[np.ndarray], object]]:
    with av.open(video, "w", options={"movflags": "+faststart"}) as container:
        exact = Fraction(rate).limit_denominator(1001)
        stream = container.add_stream("libx264", rate=exact, options={"crf": str(H264_QUALITY)})
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        yield lambda image: container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
        container.mux(stream.encode(None))


def frame_rate(recording: Path, view: VideoView = "all") -> tuple[int, float]:
    """The number of frames, and the frames per second: 1 / the median time between frames, of "all" limited to 1 to 30.

    Images are not decoded.
    """
    frames = RecordingReader(recording).frames()
    times = np.array([frame.integers(entities.EGO, "timestamp_ns", 1)[0] for frame in frames], dtype=np.int64)
    steps = np.diff(times)
    seconds = float(np.median(steps[steps > 0])) / 1e9 if (steps > 0).any() else 1.0
    return len(times), 1 / seconds if view == "images" else float(np.clip(1 / seconds, SLOWEST, FASTEST))


def _images(recording: Path, view: VideoView) -> Iterator[np.ndarray]:
    layout: tuple[Tile, ...] = ()
    images, (arrange, draw) = RecordedImages(), (image_tiles, draw_images) if view == "images" else (tiles, draw_frame)
    for frame in RecordingReader(recording).frames():
        layout = layout or arrange(frame)
        yield draw(frame, layout, images)
