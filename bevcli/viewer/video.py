"""Writes a video of a recording: all cameras with their boxes, the BEV to the right, a legend below.

H.264 in MP4, which plays everywhere, if PyAV is installed; VP9 else and in WebM.
"""

import errno
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from bevcli.errors import InputError
from bevcli.frame import MAP_CLASSES
from bevcli.geometry.object_classes import NUSCENES_CLASSES, ObjectClass, color_of_hex
from bevcli.geometry.transforms import Array
from bevcli.parsing.files import decode_image, plain_name
from bevcli.recording import entities
from bevcli.recording.blueprint import rows_of_largest_images
from bevcli.recording.entities import Color, class_colors, map_colors
from bevcli.recording.options import has_av, require_av
from bevcli.viewer.recording_reader import RecordedFrame, RecordingReader
from bevcli.writing import whole_file

MOST_PIXELS = 64 << 20
Canvas = NDArray[np.uint8]
ToCanvas = Callable[[Array], Array]  # points (K, 2) in the space of an entity -> (K, 2) pixels of a canvas
FONT = cv2.FONT_HERSHEY_SIMPLEX
SUBPIXEL_BITS = 3
STRIPS = "LineStrips2D:strips"
FAR = 1e5  # pixels; what lies farther outside of a canvas is drawn there
OPACITIES = 10  # steps of opacity, faint to opaque
WIDTH, HEIGHT = 1920, 640
BEV_SIDE = 640
CAMERAS_WIDTH = WIDTH - BEV_SIDE
CAMERAS_HEIGHT = 500
BEV_RANGE_M = 50.0  # from the vehicle to each edge of the BEV view, in recordings without range rings
BEV_MARGIN = 1.02  # of the range rings and the border of the grid
BACKGROUND = (25, 20, 18)  # BGR, as all colours of the video
BELOW_BOXES = (
    entities.BEV_GROUND_TRUTH, entities.BEV_MISSED, entities.BEV_TRACKS, entities.BEV_FALSE, entities.BEV_DUPLICATES
)  # fmt: skip
TEXT, WARNING = (225, 220, 215), (85, 70, 255)
FOURCC = {".mp4": "vp09", ".webm": "VP90"}  # VP9: OpenCV's wheels cannot write H.264
H264_QUALITY = 21  # x264's crf
SLOWEST, FASTEST = 1.0, 30.0  # frames a second


class Av1Decoder:
    """Decodes the images that an `Av1Encoder` made, in order."""

    def __init__(self) -> None:
        import av

        self._context = av.CodecContext.create("libdav1d", "r")
        self._context.options = {"max_frame_delay": "1", "threads": "1"}

    def decode(self, data: bytes) -> NDArray[np.uint8] | None:
        """The next image, (H, W, 3) uint8 BGR; None before the first keyframe and for damaged data."""
        import av

        assert isinstance(self._context, av.VideoCodecContext)
        try:
            images = self._context.decode(av.Packet(data))
        except av.FFmpegError:
            return None
        return images[-1].to_ndarray(format="bgr24").astype(np.uint8, copy=False) if images else None


class CameraImages:
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
        _draw_line(canvas, strip, color, to_canvas, thickness)


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
            _draw_line(canvas, strips[index], colors[index], to_canvas)
        canvas[:] = cv2.addWeighted(canvas, level / OPACITIES, below, 1 - level / OPACITIES, 0)


def _draw_line(canvas: Canvas, strip: Array, color: Color, to_canvas: ToCanvas, thickness: int = 1) -> None:
    points = np.round(to_canvas(strip) * (1 << SUBPIXEL_BITS)).astype(np.int32)
    cv2.polylines(canvas, [points], False, color, thickness, cv2.LINE_AA, SUBPIXEL_BITS)


def draw_arrows(canvas: Canvas, frame: RecordedFrame, entity: str, to_canvas: ToCanvas) -> None:
    """Draws the 2D arrows of an entity."""
    starts = frame.array(entity, "Arrows2D:origins", 2)
    ends = starts + frame.array(entity, "Arrows2D:vectors", 2, len(starts))
    colors = entity_colors(frame, entity, "Arrows2D:colors", len(starts))
    for start, end, color in zip(to_canvas(starts), to_canvas(ends), colors, strict=True):
        cv2.arrowedLine(canvas, start.astype(int).tolist(), end.astype(int).tolist(), color, 1, cv2.LINE_AA, 0, 0.25)


def draw_labels(canvas: Canvas, frame: RecordedFrame, entity: str, to_canvas: ToCanvas, size: float = 0.4) -> None:
    """Draws the labels of an entity as text on a dark background, centred on the labelled points."""
    positions = to_canvas(frame.array(entity, "Points2D:positions", 2))
    colors = entity_colors(frame, entity, "Points2D:colors", len(positions))
    for text, (x, y), color in zip(frame.texts(entity, "Points2D:labels"), positions, colors, strict=False):
        draw_text(canvas, text, (int(x), int(y)), color, size, centered=True)


def draw_text(
    canvas: Canvas, text: str, position: tuple[int, int], color: Color, size: float = 0.45, *, centered: bool = False
) -> None:
    """Draws a line of text.

    position: x, y, pixels, of the middle of its left edge, or of its centre if `centered`. color: BGR.
    """
    (width, height), _ = cv2.getTextSize(text, FONT, size, 1)
    left = position[0] - width // 2 if centered else position[0]
    bottom = position[1] + height // 2
    if centered:
        cv2.rectangle(canvas, (left - 2, bottom - height - 3), (left + width + 2, bottom + 3), (24, 20, 18), -1)
    cv2.putText(canvas, text, (left, bottom), FONT, size, color, 1, cv2.LINE_AA)


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
    stated = formats[0] if isinstance(formats[0], dict) else {}
    shape = (*(size if isinstance(size := stated.get(key), int) else 0 for key in ("height", "width")), 3)
    if pixels.size != math.prod(shape) or not pixels.size:
        raise frame.wrong(entity, "Image:buffer", f"{shape[1]} x {shape[0]} pixels RGB", f"{pixels.size} bytes")
    return pixels.reshape(shape)[..., ::-1]


@dataclass(frozen=True)
class Tile:
    """The rectangle of a camera's image in the video frame, pixels."""

    camera: str
    left: int
    top: int
    width: int
    height: int


def tiles(frame: RecordedFrame) -> tuple[Tile, ...]:
    """The rectangles of the cameras of a recording, in rows in the same order as in the viewer."""
    sizes = {name: _camera_size(frame, name) for name in frame.texts(entities.RUN, "camera_names")}
    if not sizes:
        raise frame.wrong(entities.RUN, "camera_names", "the names of cameras", "none")
    return tiles_of(sizes, _camera_yaws(frame))


def tiles_of(sizes: Mapping[str, ArrayLike], yaws: Mapping[str, float]) -> tuple[Tile, ...]:
    """The rectangles of cameras. sizes: width and height of their images. yaws: radians, in the ego frame."""
    whole = {name: np.asarray(size, dtype=np.float64) for name, size in sizes.items()}
    aspect = min(width / height for width, height in whole.values())
    rows = rows_of_largest_images(yaws, aspect, CAMERAS_WIDTH, CAMERAS_HEIGHT)
    cell = CAMERAS_WIDTH // max(len(row) for row in rows), CAMERAS_HEIGHT // len(rows)
    layout = []
    for r, row in enumerate(rows):
        indent = (CAMERAS_WIDTH - len(row) * cell[0]) // 2
        for c, name in enumerate(row):
            width, height = whole[name]
            scale = min(cell[0] / width, cell[1] / height)
            w, h = max(1, round(width * scale)), max(1, round(height * scale))
            left, top = indent + c * cell[0] + (cell[0] - w) // 2, r * cell[1] + (cell[1] - h) // 2
            layout.append(Tile(name, left, top, w, h))
    return tuple(layout)


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


def draw_frame(frame: RecordedFrame, layout: tuple[Tile, ...], images: CameraImages) -> Canvas:
    """The video frame, (HEIGHT, WIDTH, 3) uint8 BGR.

    layout: where each camera's image goes. images: decodes them; frames must come in order.
    """
    canvas = np.full((HEIGHT, WIDTH, 3), BACKGROUND, dtype=np.uint8)
    for tile in layout:
        image = images.image(frame, tile.camera)
        _draw_camera(canvas[tile.top : tile.top + tile.height, tile.left : tile.left + tile.width], frame, tile, image)
    _draw_bev(canvas[:, CAMERAS_WIDTH:], frame)
    _draw_legend(canvas[CAMERAS_HEIGHT:, :CAMERAS_WIDTH], frame)
    return canvas


def _draw_camera(canvas: Canvas, frame: RecordedFrame, tile: Tile, image: Canvas | None) -> None:
    width, height = _camera_size(frame, tile.camera)
    if image is not None:
        canvas[:] = cv2.resize(image, (tile.width, tile.height), interpolation=cv2.INTER_AREA)
    scale = np.array([tile.width / width, tile.height / height])

    def to_canvas(points: Array) -> Array:
        return np.clip(points * scale, -FAR, FAR)

    boxes = entities.overlay(tile.camera, "boxes")
    for kind in entities.line_kinds(frame.rows):
        draw_faded_strips(canvas, frame, entities.overlay(tile.camera, kind), to_canvas)
    draw_strips(canvas, frame, entities.overlay(tile.camera, "ground_truth"), to_canvas)
    layers = [entities.layer(entities.camera(tile.camera), name) for name in _layers(frame)]
    for each in (boxes, *layers):
        draw_strips(canvas, frame, each, to_canvas)
    for each in (boxes, *layers):
        draw_labels(canvas, frame, f"{each}/labels", to_canvas, 0.36)
    draw_title(canvas, tile.camera, has_image=image is not None)


def draw_title(canvas: Canvas, camera: str, *, has_image: bool) -> None:
    """Draws the name of a camera into the corner of its image."""
    cv2.rectangle(canvas, (0, 0), (10 * len(camera) + 12, 22), BACKGROUND, -1)
    text, color = (camera, TEXT) if has_image else (f"{camera}: no image", WARNING)
    draw_text(canvas, text, (8, 11), color, 0.42)


def _draw_bev(canvas: Canvas, frame: RecordedFrame) -> None:
    rings = max((np.abs(ring).max(initial=0) for ring in frame.strips(entities.BEV_RINGS, STRIPS)), default=0)
    reach = BEV_MARGIN * rings or BEV_RANGE_M

    def to_canvas(points: Array) -> Array:
        return np.clip((points / reach + 1) * BEV_SIDE / 2, -FAR, FAR)

    segmentation = recorded_image(frame, entities.BEV_SEGMENTATION)
    if segmentation is not None:
        _draw_placed(canvas, frame, entities.BEV_SEGMENTATION, segmentation, to_canvas)
    draw_strips(canvas, frame, entities.BEV_RINGS, to_canvas)
    draw_labels(canvas, frame, f"{entities.BEV_RINGS}/labels", to_canvas, 0.35)
    for kind in entities.line_kinds(frame.rows):
        draw_faded_strips(canvas, frame, f"{entities.BEV}/{kind}", to_canvas)
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
    x0, y0, x1, y1 = max(left, 0), max(top, 0), min(right, BEV_SIDE), min(bottom, BEV_SIDE)
    rows = (np.arange(y0, y1) - top) * image.shape[0] // max(1, bottom - top)
    columns = (np.arange(x0, x1) - left) * image.shape[1] // max(1, right - left)
    canvas[y0:y1, x0:x1] = image[rows[:, None], columns]


def _draw_legend(canvas: Canvas, frame: RecordedFrame) -> None:
    title = "".join(frame.texts(entities.RUN, "title"))
    scene = "".join(frame.texts(entities.EGO, "scene"))
    speed = "".join(frame.texts(entities.SPEED, "Points3D:labels"))
    draw_text(canvas, f"{title}   {scene}   frame {frame.index}   {speed}", (16, 24), TEXT, 0.6)
    note = "".join(frame.texts(entities.RUN, "note"))
    if any(frame.integers(entities.RUN, "untrained")):
        note = "UNTRAINED WEIGHTS: boxes are meaningless"
    draw_text(canvas, note, (CAMERAS_WIDTH - 480, 24), WARNING, 0.6)
    counts, layers = Counter(frame.texts(entities.BOXES, "name")), _layers(frame)
    for name in layers:
        counts[name] = len(frame.texts(entities.layer(entities.WORLD, name), "name"))
    for index, (name, color) in enumerate((layers or _class_colors(frame)).items()):
        position = 16 + 250 * (index % 5), 60 + 32 * (index // 5)
        draw_entry(canvas, position, color, f"{name.replace('_', ' ')} {counts[name]}")
    for index, (name, color) in enumerate(_named_colors(frame, "line_names", "line_colors").items()):
        draw_entry(canvas, (16 + 250 * index, 60 + 32 * 2), color, name)
    if frame.has(entities.BEV_SEGMENTATION, "Image:buffer"):
        # Recordings of version 0.1.0 do not name their classes, which are those of the segmentation head.
        classes = frame.texts(entities.RUN, "map_classes") or list(MAP_CLASSES)
        width = min(250, (CAMERAS_WIDTH - 16) // len(classes))
        for index, (name, color) in enumerate(map_colors(classes).items()):
            draw_entry(canvas, (16 + width * index, 60 + 32 * 2), color, f"map: {name.replace('_', ' ')}")


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


def draw_entry(canvas: Canvas, position: tuple[int, int], color: Color, text: str) -> None:
    """Draws an entry of a legend. position: x, y of its left edge. color: RGB."""
    x, y = position
    cv2.rectangle(canvas, (x, y - 7), (x + 14, y + 7), color[::-1], -1)
    draw_text(canvas, text, (x + 24, y), TEXT)


def _rotation(frame: RecordedFrame, entity: str) -> Array:
    columns = frame.array(entity, "Transform3D:mat3x3", 9)
    return columns[0].reshape(3, 3).T if len(columns) else np.eye(3)  # rerun stores matrices by columns


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
    capture = cv2.VideoCapture(video)
    frames = capture.get(cv2.CAP_PROP_FRAME_COUNT) if capture.isOpened() else -1  # computed from the times in a WebM
    if frames < max(count - 1, 0):
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
