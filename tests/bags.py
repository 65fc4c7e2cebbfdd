"""Writes a drive as bags with the packages of ROS and MCAP, which the readers under test do not use for writing."""

import base64
import json
import tempfile
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from mcap_ros2.writer import Writer as Ros2Writer
from rosbags.rosbag2 import StoragePlugin, Writer as BagWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from bevcli.frame import Drive, Frame
from bevcli.geometry.cameras import Camera
from bevcli.geometry.ego_motion import EgoMotion
from bevcli.geometry.transforms import Pose

# One message: topic, type, time in ns, fields.
Message = tuple[str, str, int, dict[str, Any]]

VIDEO = "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format"


@cache
def store() -> Typestore:
    """The types of messages."""
    types = get_typestore(Stores.ROS2_HUMBLE)
    types.register(get_types_from_msg(VIDEO, "foxglove_msgs/msg/CompressedVideo"))
    return types


@cache
def definition(name: str) -> str:
    """The text of a type's definition with those of all types that it contains."""
    return store().generate_msgdef(name, ros_version=2)[0]


def stamp(time_ns: int) -> dict[str, int]:
    """builtin_interfaces/Time."""
    return {"sec": time_ns // 10**9, "nanosec": time_ns % 10**9}


def header(time_ns: int, frame: str) -> dict[str, Any]:
    """std_msgs/Header."""
    return {"stamp": stamp(time_ns), "frame_id": frame}


def xyz(values: Any) -> dict[str, float]:
    """Vector3 or Point."""
    return dict(zip("xyz", map(float, values), strict=True))


def quaternion(values: Any) -> dict[str, float]:
    """Quaternion from w, x, y, z."""
    return dict(zip("wxyz", map(float, values), strict=True))


def transform(time_ns: int, parent: str, child: str, pose: Pose) -> dict[str, Any]:
    """TransformStamped."""
    inner = {"translation": xyz(pose.translation), "rotation": quaternion(pose.quaternion)}
    return {"header": header(time_ns, parent), "child_frame_id": child, "transform": inner}


def odometry(time_ns: int, frame: str, child: str, pose: Pose) -> dict[str, Any]:
    """nav_msgs/Odometry with a twist of zero."""
    inner = {"position": xyz(pose.translation), "orientation": quaternion(pose.quaternion)}
    zero = {"linear": xyz(np.zeros(3)), "angular": xyz(np.zeros(3))}
    return {
        "header": header(time_ns, frame),
        "child_frame_id": child,
        "pose": {"pose": inner, "covariance": [0.0] * 36},
        "twist": {"twist": zero, "covariance": [0.0] * 36},
    }


def camera_info(camera: Camera, time_ns: int, frame: str) -> dict[str, Any]:
    """sensor_msgs/CameraInfo."""
    lens = camera.distortion
    model = "plumb_bob" if lens is None or lens.model == "brown_conrady" else "equidistant"
    k = camera.intrinsics
    return {
        "header": header(time_ns, frame),
        "height": camera.height,
        "width": camera.width,
        "distortion_model": "rational_polynomial" if lens and len(lens.coefficients) == 8 else model,
        "d": [0.0] * 5 if lens is None else list(lens.coefficients),
        "k": k.ravel().tolist(),
        "r": np.eye(3).ravel().tolist(),
        "p": np.column_stack([k, np.zeros(3)]).ravel().tolist(),
        "binning_x": 0,
        "binning_y": 0,
        "roi": {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False},
    }


def drive_messages(
    sequence: Drive, ego_motion: EgoMotion | None, *, poses_in: str = "odometry", delay_ns: int = 0
) -> Iterator[Message]:
    """A drive as ROS messages: images, calibration, static transforms, and poses as "odometry" or "tf".

    delay_ns: from the capture of each image to its recording.
    """
    start = min(stamp.timestamp_ns for stamp in sequence.stamps)
    static = [
        transform(start, "base_link", f"{c.name}_optical", Pose.from_matrix(c.ego_from_camera))
        for c in sequence.rig.cameras
    ]
    yield "/tf_static", "tf2_msgs/TFMessage", start, {"transforms": static}
    for camera in sequence.rig.cameras:
        info = camera_info(camera, start, f"{camera.name}_optical")
        yield f"/{camera.name}/camera_info", "sensor_msgs/CameraInfo", start, info
    if ego_motion is not None:
        yield from _pose_messages(ego_motion, poses_in)
    for place in range(len(sequence.stamps)):
        yield from _image_messages(sequence.load(place), delay_ns)


def _pose_messages(ego_motion: EgoMotion, poses_in: str) -> Iterator[Message]:
    rows = zip(ego_motion.timestamps_ns.tolist(), ego_motion.translations, ego_motion.quaternions, strict=True)
    for time, translation, rotation in rows:
        pose = Pose(translation, rotation)
        if poses_in == "odometry":
            yield "/odom", "nav_msgs/Odometry", time, odometry(time, "map", "base_link", pose)
        else:
            yield "/tf", "tf2_msgs/TFMessage", time, {"transforms": [transform(time, "map", "base_link", pose)]}


def _image_messages(frame: Frame, delay_ns: int) -> Iterator[Message]:
    for name, image in frame.images.items():
        assert image.encoded is not None
        fields = {
            "header": header(image.timestamp_ns, f"{name}_optical"),
            "format": str(image.media_type).removeprefix("image/"),
            "data": image.encoded,
        }
        yield f"/{name}/image/compressed", "sensor_msgs/CompressedImage", image.timestamp_ns + delay_ns, fields


def write_mcap(
    path: Path, messages: Iterator[Message] | list[Message], *, chunk_size: int = 200_000, packed: bool = True
) -> Path:
    """An MCAP file with ROS 2 messages, in order of time."""
    with path.open("wb") as file:
        writer = Ros2Writer(
            file, chunk_size=chunk_size, compression=CompressionType.ZSTD if packed else CompressionType.NONE
        )
        schemas: dict[str, Any] = {}
        for topic, kind, time, fields in sorted(messages, key=lambda message: message[2]):
            if kind not in schemas:
                name = kind.replace("/", "/msg/")
                schemas[kind] = writer.register_msgdef(name, definition(name))
            writer.write_message(topic, schemas[kind], fields, log_time=time, publish_time=time)
        writer.finish()
    return path


def write_rosbag2(folder: Path, messages: Iterator[Message] | list[Message], storage: str = "sqlite3") -> Path:
    """A rosbag2 folder with metadata.yaml and a .db3 or .mcap file."""
    plugin = StoragePlugin.SQLITE3 if storage == "sqlite3" else StoragePlugin.MCAP
    with tempfile.TemporaryDirectory() as made, BagWriter(folder, version=9, storage_plugin=plugin) as writer:
        connections: dict[str, Any] = {}
        with write_mcap(Path(made) / "bag.mcap", messages).open("rb") as file:
            for schema, channel, message in make_reader(file).iter_messages():
                if channel.topic not in connections:
                    connections[channel.topic] = writer.add_connection(channel.topic, schema.name, typestore=store())
                writer.write(connections[channel.topic], message.log_time, message.data)
    return folder


def write_json_mcap(path: Path, messages: list[Message]) -> Path:
    """An MCAP file with Foxglove's schemas in JSON. Bytes are written as base64."""

    def encode(fields: dict[str, Any]) -> bytes:
        return json.dumps(fields, default=lambda data: base64.b64encode(data).decode()).encode()

    return write_encoded(path, messages, encode, "json", "jsonschema", lambda kind: b"{}")


def write_protobuf_mcap(path: Path, messages: list[Message], files: Any) -> Path:
    """An MCAP file with Foxglove's schemas in Protobuf. files: a FileDescriptorSet with their types."""
    from google.protobuf import descriptor_pool, json_format, message_factory

    pool = descriptor_pool.DescriptorPool()
    for file in files.file:
        pool.Add(file)

    def encode(fields: dict[str, Any]) -> bytes:
        name = fields.pop("__type")
        message = message_factory.GetMessageClass(pool.FindMessageTypeByName(name))()
        text = json.loads(json.dumps(fields, default=lambda data: base64.b64encode(data).decode()))
        return json_format.ParseDict(text, message).SerializeToString()

    typed = [(topic, kind, time, {**fields, "__type": kind}) for topic, kind, time, fields in messages]
    return write_encoded(path, typed, encode, "protobuf", "protobuf", lambda kind: files.SerializeToString())


def write_encoded(
    path: Path,
    messages: list[Message],
    encode: Callable[[dict[str, Any]], bytes],
    encoding: str,
    schema_encoding: str,
    schema_of: Callable[[str], bytes],
) -> Path:
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.LZ4)
        writer.start()
        channels: dict[str, int] = {}
        for topic, kind, time, fields in sorted(messages, key=lambda message: message[2]):
            if topic not in channels:
                schema = writer.register_schema(kind, schema_encoding, schema_of(kind))
                channels[topic] = writer.register_channel(topic, encoding, schema)
            writer.add_message(channels[topic], log_time=time, publish_time=time, data=encode(fields))
        writer.finish()
    return path
