"""The bytes of a message (ROS 2's CDR, JSON, Protobuf) -> its fields -> this package's types.

ROS messages and Foxglove's schemas (in CDR, JSON or Protobuf) name the same things differently; this is the one place
that knows the names.
"""

import base64
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array, Pose, rigid
from bevcli.parsing.documents import LARGEST_INTEGER, parse_json
from bevcli.sequences.files.calibration_file import parse_camera
from bevcli.sequences.files.json_fields import require, transform_to_json
from bevcli.workshop.formats.named_calibration import lens_fields

Kind = Literal["image", "video", "calibration", "transforms", "pose"]
# The types by what they are used for, of each kind the preferred one first. Names without "msg/", and "foxglove" for
# foxglove_msgs, too.
KINDS: dict[str, Kind] = {
    "sensor_msgs/CompressedImage": "image",
    "foxglove/CompressedImage": "image",
    "sensor_msgs/Image": "image",
    "foxglove/RawImage": "image",
    "foxglove/CompressedVideo": "video",
    "sensor_msgs/CameraInfo": "calibration",
    "foxglove/CameraCalibration": "calibration",
    "tf2_msgs/TFMessage": "transforms",
    "geometry_msgs/TransformStamped": "transforms",
    "foxglove/FrameTransform": "transforms",
    "foxglove/FrameTransforms": "transforms",
    "nav_msgs/Odometry": "pose",
    "foxglove/PoseInFrame": "pose",
    "geometry_msgs/PoseWithCovarianceStamped": "pose",
    "geometry_msgs/PoseStamped": "pose",
}
FARTHEST = 1e12  # of a coordinate in metres, as in calibration.json
Decode = Callable[[bytes], Any]


@dataclass(frozen=True)
class Topic:
    """A topic of a bag.

    Attributes:
        name: such as "/camera/front/image_raw".
        type_name: as the bag writes it, such as "sensor_msgs/msg/Image".
        encoding: of its messages: "cdr", "json" or "protobuf".
        schema: encoding of the definition: "ros2msg", "ros2idl", "jsonschema", "protobuf"; "" if there is none.
        definition: the definition of the type, empty if there is none.
    """

    name: str
    type_name: str
    encoding: str
    schema: str = ""
    definition: bytes = b""

    @property
    def short_type(self) -> str:
        """The name of the type as in KINDS: "sensor_msgs/msg/Image" -> "sensor_msgs/Image"."""
        name = self.type_name.replace("/msg/", "/").replace("foxglove_msgs/", "foxglove/")
        return name.replace("foxglove.", "foxglove/")


def decoder(topic: Topic) -> Decode:
    """The function that decodes a topic's messages. Nested messages are objects with attributes, too.

    Raises InputError if the encoding is not supported, or the definition is broken.
    """
    makers = {"cdr": _cdr, "json": _json, "protobuf": _protobuf}
    make = makers.get(topic.encoding)
    if make is None:
        hint = ": convert the .bag of ROS 1 with rosbags-convert" if topic.encoding == "ros1" else ""
        raise InputError(f"{topic.name}: messages are encoded as {topic.encoding} (expected {', '.join(makers)}){hint}")
    return make(topic)


def _cdr(topic: Topic) -> Decode:
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
    from rosbags.typesys.store import TypesysError

    name = topic.type_name if "/msg/" in topic.type_name else topic.type_name.replace("/", "/msg/")
    text = topic.definition.decode(errors="replace")
    try:
        store = get_typestore(Stores.EMPTY if text else Stores.LATEST)
        if text:
            is_idl = topic.schema == "ros2idl"
            store.register(get_types_from_idl(text) if is_idl else get_types_from_msg(text, name))
        store.get_msgdef(name)
    except (TypesysError, KeyError, ValueError) as error:
        found = "its definition cannot be read" if text else "the bag has no definition of it, and it is not a ROS type"
        raise InputError(f"{topic.name}: type {name}: {found} ({error})") from None
    return lambda data: store.deserialize_cdr(data, name)


def _json(topic: Topic) -> Decode:
    # Objects with attributes in place of dicts.
    return lambda data: parse_json(data, Path(topic.name), pairs=lambda pairs: SimpleNamespace(**dict(pairs)))


def _protobuf(topic: Topic) -> Decode:
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
    from google.protobuf.message import DecodeError

    pool = descriptor_pool.DescriptorPool()
    try:
        files = descriptor_pb2.FileDescriptorSet.FromString(topic.definition)
        message_factory.GetMessages(files.file, pool)  # adds each file after those that it imports
        message = message_factory.GetMessageClass(pool.FindMessageTypeByName(topic.type_name))
    except (DecodeError, KeyError, TypeError) as error:
        raise InputError(f"{topic.name}: the definition of {topic.type_name} cannot be read ({error})") from None
    return message.FromString


@dataclass(frozen=True)
class Transform:
    """The pose of a child frame in its parent at a time.

    timestamp_ns: 0 if it is not stated. parent_from_child: None for numbers that are no pose, such as NaN.
    """

    parent: str
    child: str
    timestamp_ns: int
    parent_from_child: Pose | None


def timestamp_ns(message: Any) -> int:
    """The time that a message states, ns; 0 if it states none, or one that is too large."""
    header = getattr(message, "header", None)
    stamp = header.stamp if header is not None else getattr(message, "timestamp", None)
    if stamp is None:
        return 0
    seconds = _first(stamp, "sec", "seconds")
    time = int(seconds) * 1_000_000_000 + int(_first(stamp, "nanosec", "nsec", "nanos", "nanoseconds"))
    return time if abs(time) <= LARGEST_INTEGER else 0


def frame_of(message: Any) -> str:
    """The name of the frame that a message is in, without a slash before it."""
    header = getattr(message, "header", None)
    name = header.frame_id if header is not None else getattr(message, "frame_id", "")
    return str(name).lstrip("/")


def payload(message: Any) -> bytes:
    """The bytes of an image message."""
    data = message.data
    return base64.b64decode(data) if isinstance(data, str) else bytes(memoryview(data))


def transforms_of(message: Any) -> Iterator[Transform]:
    """The transforms of a message: TFMessage, TransformStamped, FrameTransform, FrameTransforms, or of `pose_of`."""
    if hasattr(message, "pose"):
        yield pose_of(message)
        return
    for part in message.transforms if hasattr(message, "transforms") else (message,):
        parent = frame_of(part) if hasattr(part, "transform") else str(part.parent_frame_id).lstrip("/")
        child, inner = str(part.child_frame_id).lstrip("/"), getattr(part, "transform", part)
        yield Transform(parent, child, timestamp_ns(part), _pose(inner.translation, inner.rotation))


def pose_of(message: Any) -> Transform:
    """The pose that a message states: Odometry, PoseStamped, PoseWithCovarianceStamped or PoseInFrame.

    `child` is "" where the message does not name the frame.
    """
    inner = message.pose.pose if hasattr(message.pose, "pose") else message.pose
    child = str(getattr(message, "child_frame_id", "")).lstrip("/")
    return Transform(frame_of(message), child, timestamp_ns(message), _pose(inner.position, inner.orientation))


def camera_of(message: Any, name: str, ego_from_camera: Array, *, rectified: bool, where: str) -> Camera:
    """The camera of a CameraInfo or CameraCalibration.

    ego_from_camera: (4, 4) of the optical frame, metres. rectified: lens distortion was removed from the images. where:
    start of an error message.
    K and P of a CameraInfo are those of the whole sensor: the image is its region of interest, then binned.
    Raises InputError if the intrinsics are not set or not those of a camera, or have an unknown distortion model.
    """
    binning = [max(1, int(getattr(message, name, 1) or 1)) for name in ("binning_x", "binning_y")]
    region = getattr(message, "roi", None)
    if region is None or not (region.width and region.height):
        region = SimpleNamespace(x_offset=0, y_offset=0, width=message.width, height=message.height)
    width, height = int(region.width) // binning[0], int(region.height) // binning[1]
    scale = np.diag([1 / binning[0], 1 / binning[1], 1.0])
    image_from_sensor = scale @ [[1, 0, -region.x_offset], [0, 1, -region.y_offset], [0, 0, 1]]
    intrinsics = image_from_sensor @ _matrix(_first(message, "k", "K"), 3, 3)
    if not (np.isfinite(intrinsics).all() and min(intrinsics[0, 0], intrinsics[1, 1]) > 0):
        raise InputError(
            f"{where}: the camera is not calibrated (K is zero or NaN): pass `calibration` (`--calibration FILE`)"
        )
    projection = image_from_sensor @ _matrix(_first(message, "p", "P"), 3, 4)
    rotation = _matrix(_first(message, "r", "R"), 3, 3)
    if rectified and projection[0, 0] > 0:
        rectified_from_camera = rotation if abs(np.linalg.det(rotation) - 1) < 1e-3 else np.eye(3)
        intrinsics, ego_from_camera = projection[:, :3], ego_from_camera @ rigid((0, 0, 0), rectified_from_camera.T)
    coefficients = [] if rectified else [float(d) for d in _first(message, "d", "D")]
    fields = {
        "width": width,
        "height": height,
        "intrinsics": intrinsics.tolist(),
        "distortion": lens_fields(message.distortion_model, coefficients, where),
        "ego_from_camera": transform_to_json(ego_from_camera),
    }
    return require(parse_camera, name, fields, where=where, camera=name)


def _pose(translation: Any, rotation: Any) -> Pose | None:
    quaternion = np.array([rotation.w, rotation.x, rotation.y, rotation.z], dtype=np.float64)
    position = np.array([translation.x, translation.y, translation.z], dtype=np.float64)
    norm = float(np.linalg.norm(quaternion))
    return Pose(position, quaternion / norm) if 0.9 < norm < 1.1 and (abs(position) < FARTHEST).all() else None


def _matrix(values: Any, rows: int, columns: int) -> Array:
    numbers = np.array(list(values), dtype=np.float64)
    return numbers.reshape(rows, columns) if numbers.size == rows * columns else np.zeros((rows, columns))


def _first(owner: Any, *names: str) -> Any:
    """The first of several attributes that an object has. Protobuf and ROS write the same fields differently."""
    for name in names:
        if hasattr(owner, name):
            return getattr(owner, name)
    raise ValueError(f"the field {names[0]} is missing")


def decompressed(kind: str, data: bytes, largest: int) -> bytes:
    """The bytes of compressed data.

    kind: "zstd", "lz4", or "" for data that is not compressed.
    Raises ValueError for another kind, damaged data, or more than `largest` bytes. Data that is cut off may give less.
    """
    kinds = {"zstd": _from_zstd, "lz4": _from_lz4, "": lambda data, largest: data}
    if kind not in kinds:
        raise ValueError(f'unknown compression "{kind:.20}" (expected zstd, lz4 or none)')
    found = kinds[kind](data, largest + 1)
    if len(found) > largest:
        raise ValueError(f"has more than {largest} bytes when it is decompressed")
    return found


def _from_zstd(data: bytes, largest: int) -> bytes:
    import zstandard

    try:
        return zstandard.ZstdDecompressor().stream_reader(data).read(largest)
    except zstandard.ZstdError as error:
        raise ValueError(str(error)) from None


def _from_lz4(data: bytes, largest: int) -> bytes:
    import lz4.frame  # type: ignore[import-not-found,import-untyped,unused-ignore]

    try:
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, largest))
    except (RuntimeError, EOFError) as error:
        raise ValueError(str(error)) from None
