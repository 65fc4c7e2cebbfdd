"""Writes a drive as bags with the packages of ROS and MCAP, which the readers under test do not use for writing."""

import base64
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer
from mcap_ros2.writer import Writer as Ros2Writer

from bevcli.frame import Drive, Frame
from bevcli.geometry.cameras import Camera
from bevcli.geometry.ego_motion import EgoMotion
from bevcli.geometry.transforms import Pose

# One message: topic, type, time in ns, fields.
Message = tuple[str, str, int, dict[str, Any]]

SEPARATOR = "\n" + "=" * 80 + "\n"
PARTS = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
    "geometry_msgs/Transform": "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation",
    "geometry_msgs/TransformStamped": "std_msgs/Header header\nstring child_frame_id\n"
    "geometry_msgs/Transform transform",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance",
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular",
    "geometry_msgs/TwistWithCovariance": "geometry_msgs/Twist twist\nfloat64[36] covariance",
    "geometry_msgs/PoseStamped": "std_msgs/Header header\ngeometry_msgs/Pose pose",
    "nav_msgs/Odometry": "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n"
    "geometry_msgs/TwistWithCovariance twist",
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "sensor_msgs/CompressedImage": "std_msgs/Header header\nstring format\nuint8[] data",
    "sensor_msgs/Image": "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\n"
    "uint32 step\nuint8[] data",
    "sensor_msgs/RegionOfInterest": "uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify",
    "sensor_msgs/CameraInfo": "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\n"
    "float64[] d\nfloat64[9] k\nfloat64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\n"
    "sensor_msgs/RegionOfInterest roi",
    "sensor_msgs/NavSatStatus": "int8 status\nuint16 service",
    "sensor_msgs/NavSatFix": "std_msgs/Header header\nsensor_msgs/NavSatStatus status\nfloat64 latitude\n"
    "float64 longitude\nfloat64 altitude\nfloat64[9] position_covariance\nuint8 position_covariance_type",
    "std_msgs/String": "string data",
    "foxglove_msgs/CompressedVideo": "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format",
}


def definition(name: str) -> str:
    """The text of a type's definition with those of all types that it contains."""
    needed, found = [name], []
    while needed:
        part = needed.pop(0)
        if part in found:
            continue
        found.append(part)
        needed += [line.split("[")[0].split(" ")[0] for line in PARTS[part].split("\n") if "/" in line]
    first, *others = found
    return PARTS[first] + "".join(f"{SEPARATOR}MSG: {other}\n{PARTS[other]}" for other in others)


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
                schemas[kind] = writer.register_msgdef(kind.replace("/", "/msg/"), definition(kind))
            writer.write_message(topic, schemas[kind], fields, log_time=time, publish_time=time)
        writer.finish()
    return path


def write_rosbag2(folder: Path, messages: Iterator[Message] | list[Message], storage: str = "sqlite3") -> Path:
    """A rosbag2 folder with metadata.yaml and a .db3 or .mcap file."""
    from rosbags.rosbag2 import StoragePlugin, Writer as BagWriter
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    plugin = StoragePlugin.SQLITE3 if storage == "sqlite3" else StoragePlugin.MCAP
    with BagWriter(folder, version=9, storage_plugin=plugin) as writer:
        connections: dict[str, Any] = {}
        for topic, kind, time, fields in sorted(messages, key=lambda message: message[2]):
            name = kind.replace("/", "/msg/")
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=store)
            writer.write(connections[topic], time, store.serialize_cdr(_ros_object(store, name, fields), name))
    return folder


def _ros_object(store: Any, name: str, fields: dict[str, Any]) -> Any:
    """A message object of rosbags from nested dictionaries."""
    kinds = dict(store.fielddefs[name][1])
    return store.types[name](**{key: _ros_value(store, kinds[key], fields[key]) for key in kinds})


def _ros_value(store: Any, kind: Any, value: Any) -> Any:
    node, detail = int(kind[0]), kind[1]
    if node == 2:  # a message
        return _ros_object(store, detail, value)
    if node in (3, 4):  # arrays
        inner = detail[0]
        if int(inner[0]) == 2:
            return [_ros_object(store, inner[1], one) for one in value]
        dtype = np.uint8 if isinstance(value, bytes) else np.float64
        return np.frombuffer(value, dtype=dtype) if isinstance(value, bytes) else np.array(value, dtype=dtype)
    return value


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
