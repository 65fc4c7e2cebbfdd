"""The entity paths of a recording, and the colours of what is drawn. Writer, reader and blueprint share them.

`world` is the sequence's world frame, moved so that the first frame's ego position is its origin (the viewer computes
in float32). `bev` is a flat image of the bev frame in metres: x to the right, -y down. `map` holds latitudes and
longitudes, where the drive states its place on Earth. Lines on the ground are directly below `world` and `bev`, by
their kind (`line_kinds`), such as "bev/map_lines".

Colours are RGB, 0 to 255.
"""

import colorsys
from collections.abc import Hashable, Iterable, Mapping, Sequence
from functools import cache, lru_cache
from itertools import cycle
from struct import Struct
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import ArrayLike, NDArray

from bevcli.geometry.object_classes import Color, ObjectClass
from bevcli.geometry.transforms import Array

Components = dict[rr.ComponentDescriptor, pa.Array]
CONSTANTS = 4096  # that are kept as Arrow arrays


def log(stream: rr.RecordingStream, entity: str, row: Components, *, static: bool = False) -> None:
    """Writes a row, as `stream.log`, which takes twice as long."""
    rr.bindings.log_arrow_msg(entity, components=row, static_=static, recording=stream.to_native())


def components(archetype: Any, **fields: Any) -> Components:
    """The components of an archetype, a class of rerun such as `rr.Points2D`.

    fields: by the names of `archetype.from_fields`; None leaves one out. A field is an Arrow array of the component's
    type, an array of numbers (colours as `packed` takes or returns them), a list of texts, or what can be hashed and
    rerun takes, which is converted once.
    """
    row: Components = {}
    for name, value in fields.items():
        if value is not None:
            descriptor, arrow_type = _field(archetype, name)
            if isinstance(value, pa.Array):
                row[descriptor] = value
            elif isinstance(value, np.ndarray):
                row[descriptor] = _numbers(value, arrow_type)
            elif isinstance(value, list) and pa.types.is_string(arrow_type):
                row[descriptor] = pa.array(value, arrow_type)
            else:
                row[descriptor] = _constant(archetype, name, value)
    return row


def any_values(**values: Any) -> Components:
    """As `rr.AnyValues`, with the same type in every row: arrays of numbers or texts, or single values."""
    row: Components = {}
    for name, value in values.items():
        array = np.atleast_1d(value)  # typed, so that an array without values is a value too
        row[rr.ComponentDescriptor(name)] = (
            pa.array(array.tolist(), pa.utf8()) if array.dtype.kind == "U" else pa.array(array)
        )
    return row


@lru_cache(maxsize=64)
def ui_points(width: float) -> pa.Array:
    """A radius in points of the user interface, for all lines or points of an entity."""
    return rr.components.RadiusBatch(rr.Radius.ui_points(width)).as_arrow_array()


def line_strips(points: Array, lengths: Sequence[int]) -> pa.Array:
    """Strips, each with a number of points of its own. points: (P, 2 or 3) of all of them, one after the other."""
    _, arrow_type = _field(rr.LineStrips2D if points.shape[1] == 2 else rr.LineStrips3D, "strips")
    return _lists(points, np.cumsum([0, *lengths], dtype=np.int32), arrow_type)


@lru_cache(maxsize=64)
def rgb_format(width: int, height: int) -> pa.Array:
    """The format of an image (height, width, 3) of bytes, RGB."""
    image_format = rr.components.ImageFormat(width=width, height=height, channel_datatype="U8", color_model="RGB")
    return rr.components.ImageFormatBatch(image_format).as_arrow_array()


@cache
def _field(archetype: Any, name: str) -> tuple[rr.ComponentDescriptor, pa.DataType]:
    (batch,) = archetype.from_fields(**{name: []}).as_component_batches()
    return batch.component_descriptor(), batch.as_arrow_array().type


@lru_cache(maxsize=CONSTANTS)
def _constant(archetype: Any, name: str, value: Hashable) -> pa.Array:
    (batch,) = archetype.from_fields(**{name: value}).as_component_batches()
    return batch.as_arrow_array()


def _numbers(value: NDArray[Any], arrow_type: pa.DataType) -> pa.Array:
    if pa.types.is_uint32(arrow_type) and value.dtype == np.uint8:
        return pa.array(packed(value))
    if pa.types.is_list(arrow_type):  # strips (N, points, 2 or 3), or the bytes (N,) of a file or an image
        if value.ndim == 1:
            return _lists(value, np.array([0, len(value)], np.int32), arrow_type)
        offsets = np.arange(len(value) + 1, dtype=np.int32) * np.int32(value.shape[1])
        return _lists(value.reshape(-1, value.shape[2]), offsets, arrow_type)
    is_vector = pa.types.is_fixed_size_list(arrow_type)
    of_number = (arrow_type.value_type if is_vector else arrow_type).to_pandas_dtype()
    numbers = pa.array(value.reshape(-1).astype(of_number, copy=False))
    return pa.FixedSizeListArray.from_arrays(numbers, type=arrow_type) if is_vector else numbers


def _lists(rows: NDArray[Any], offsets: NDArray[np.int32], arrow_type: pa.DataType) -> pa.Array:
    """Lists of consecutive rows: numbers, or vectors (N, 2 or 3)."""
    return pa.ListArray.from_arrays(pa.array(offsets), _numbers(rows, arrow_type.value_type), type=arrow_type)


def packed(colors: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """Colours (N, 3 or 4) -> (N,), red in the highest byte, then green, blue and opacity."""
    if colors.shape[-1] == 3:
        opaque = np.full((len(colors), 4), 255, np.uint8)
        opaque[:, :3] = colors
        colors = opaque
    return np.ascontiguousarray(colors).view(">u4").reshape(-1).astype(np.uint32)


# An .rrd file: bytes of its header, and the kind and the length before each of its messages.
FILE_HEADER, MESSAGE_HEADER = 12, Struct("<QQ")
INDEX, MESSAGE_KINDS = 0, (1, 2, 3)  # facts of the recording, data, and the choice of a blueprint

WORLD = "world"
EGO = "world/ego"
VEHICLE = "world/ego/vehicle"
RANGE_RINGS = "world/ego/range_rings"
BEV_ON_GROUND = "world/ego/bev_map"
SEGMENTATION_ON_GROUND = "world/ego/segmentation"
SPEED = "world/ego/speed"
PILLARS = "world/ego/pillars"
PROBES = "world/ego/probes"
TRAJECTORY = "world/trajectory"
BOXES = "world/boxes"
VELOCITY = "world/boxes/velocity"
FALSE_BOXES = "world/boxes/false"
DUPLICATES = "world/boxes/duplicate"
MODELS = "models"  # a kind of boxes: two models that are compared, by name
TRACKS = "world/tracks"
GROUND_TRUTH = "world/ground_truth"
MISSED = "world/ground_truth/missed"

BEV = "bev"
BEV_FEATURES = "bev/features"
BEV_SEGMENTATION = "bev/segmentation"
BEV_HISTORY = "bev/history"
BEV_RINGS = "bev/range_rings"
BEV_VEHICLE = "bev/vehicle"
BEV_BOXES = "bev/boxes"
BEV_VELOCITY = "bev/boxes/velocity"
BEV_FALSE = "bev/boxes/false"
BEV_DUPLICATES = "bev/boxes/duplicate"
BEV_TRACKS = "bev/tracks"
BEV_GROUND_TRUTH = "bev/ground_truth"
BEV_MISSED = "bev/ground_truth/missed"
BEV_PROBES = "bev/probes"

# What a frame without results does not have, beside boxes.
OF_THE_INSIDE = (
    BEV_FEATURES, BEV_ON_GROUND, BEV_SEGMENTATION, SEGMENTATION_ON_GROUND, BEV_HISTORY, BEV_PROBES, PROBES
)  # fmt: skip

MAP = "map"
MAP_EGO = "map/ego"
MAP_ROUTE = "map/route"
MAP_BOXES = "map/boxes"

STAGE_CURVES = "curves/time_per_stage"
BOX_CURVES = "curves/boxes_per_class"
SPEED_CURVE = "curves/speed"
LEGEND = "legend"
EVENTS = "events"
RUN = "run"
FUTURES = "futures"  # a kind of lines on the ground
IMAGE_BOXES = "image_boxes"  # an overlay: the boxes that a detector sees in the image
NO_IMAGE = "no_image"  # an overlay: the text in place of an image
# Last parts of the entities below "bev" that are no lines of a model's results.
OTHER_BELOW_BEV = {
    *("features", "segmentation", "history", "range_rings", "vehicle", "boxes", "tracks", "ground_truth", "probes"),
    "models",
}

FRAME_TIMELINE = "frame"
TIME_TIMELINE = "time"

GROUND_TRUTH_COLOR: Color = (235, 238, 245)
OTHER_COLOR: Color = (128, 132, 140)  # ground truth of a class that is not among the model's
MISSED_COLOR: Color = (255, 45, 85)
FALSE_COLOR: Color = (255, 45, 85)
EGO_COLOR: Color = (90, 200, 250)
LAYER_COLORS: tuple[Color, Color] = ((255, 158, 44), (178, 130, 255))  # two models: orange and violet
STAGE_COLORS: tuple[Color, ...] = (
    (96, 165, 255), (255, 158, 44), (70, 222, 190), (240, 108, 190), (245, 222, 90), (178, 130, 255), (186, 222, 92),
)  # fmt: skip
DUPLICATE_COLOR: Color = (150, 156, 170)
RING_COLOR: Color = (92, 98, 112)
RING_LABEL_COLOR: Color = (150, 156, 170)
TEXT_COLOR: Color = (225, 228, 235)
PROBE_COLOR: Color = (255, 80, 220)
GROUND_GRID_COLOR: Color = (120, 205, 140)
HORIZON_COLOR: Color = (255, 214, 64)
PILLAR_COLOR: Color = (235, 238, 245)
# Dark and hardly coloured, so that nothing on a map looks like a box. The views have a dark background in every theme.
MAP_COLORS: dict[str, Color] = {
    "drivable_road": (58, 64, 75),
    "lane_boundary": (112, 112, 100),
    "pedestrian_crossing": (86, 76, 104),
    "vehicle": (44, 84, 112),
    "drivable_area": (70, 78, 72),
    "divider": (125, 95, 55),
    "contour": (20, 125, 120),
}
# For classes that are not in MAP_COLORS.
OTHER_MAP_COLORS: tuple[Color, ...] = (
    (85, 45, 20), (90, 125, 80), (75, 40, 80), (65, 70, 20), (35, 55, 100), (125, 85, 80), (20, 80, 55), (90, 40, 55),
)  # fmt: skip
BACKGROUND: Color = (18, 20, 25)


def camera(name: str) -> str:
    """The entity of a camera: its pose and its pinhole; image and overlays are below it."""
    return f"world/cameras/{name}"


def image(name: str) -> str:
    """The entity of a camera's image."""
    return f"{camera(name)}/picture"


def track(class_name: str, identity: str) -> str:
    """The entity of a track, such as "world/tracks/car_12"."""
    return f"{TRACKS}/{_escaped(f'{class_name}_{identity}')}"


def layer(root: str, name: str) -> str:
    """The entity of the boxes of one of two models, such as "bev/models/a". root: WORLD, BEV or that of a camera."""
    return f"{root}/{MODELS}/{_escaped(name)}"


def class_mesh(class_name: str) -> str:
    """The entity of the mesh in all boxes of a class, such as "world/boxes/mesh/car"."""
    return f"{BOXES}/mesh/{_escaped(class_name)}"


def _escaped(name: str) -> str:
    """A name as one part of a path, by rerun's rules."""
    return rr.escape_entity_path_part(name)


def overlay(name: str, kind: str) -> str:
    """The entity of an image overlay. kind: "boxes", "boxes/labels", IMAGE_BOXES, "ground_truth", "pillars",
    "probes", NO_IMAGE, or a kind of lines on the ground.
    """
    return f"{camera(name)}/{kind}"


def line_kinds(recorded: Iterable[str]) -> list[str]:
    """Kinds of lines on the ground among the entities of a recording, such as "map_lines"; futures come last."""
    below = {entity.removeprefix(f"{BEV}/").partition("/")[0] for entity in recorded if entity.startswith(f"{BEV}/")}
    return [*sorted(below - OTHER_BELOW_BEV - {FUTURES}), FUTURES]


def class_colors(classes: Iterable[ObjectClass]) -> dict[str, Color]:
    """The colours of a model's classes, in their order. A class without a colour takes one by its index."""
    return {object_class.name: object_class.color or index_color(index) for index, object_class in enumerate(classes)}


def index_color(index: int) -> Color:
    """A bright colour; neighbouring indices differ much."""
    red, green, blue = colorsys.hsv_to_rgb((0.11 + index * 0.618034) % 1.0, 0.65, 1.0)
    return round(red * 255), round(green * 255), round(blue * 255)


def map_colors(
    classes: Iterable[str], named: Mapping[str, Color] = MAP_COLORS, others: Iterable[Color] = OTHER_MAP_COLORS
) -> dict[str, Color]:
    """Map class -> colour, in the order of the classes. Classes that are not in `named` take `others` in turn."""
    rest = cycle(others)
    return {name: named[name] if name in named else next(rest) for name in classes}


def colormap(values: ArrayLike, name: str = "viridis") -> NDArray[np.uint8]:
    """Values 0 to 1 of any shape (...,) -> colours (..., 3) uint8 RGB. name: one of OpenCV's colour maps."""
    indices = np.clip(np.asarray(values, dtype=np.float64) * 255, 0, 255).astype(np.uint8)
    levels = np.arange(256, dtype=np.uint8)[:, None]
    colors = cv2.applyColorMap(levels, getattr(cv2, f"COLORMAP_{name.upper()}"))[:, 0, ::-1]  # (256, 3) RGB
    return np.asarray(colors.take(indices, axis=0), dtype=np.uint8)
