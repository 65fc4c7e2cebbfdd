"""The fields of a decoded message -> this package's types.

ROS messages and Foxglove's schemas (in CDR, JSON or Protobuf) name the same things differently; this is the one place
that knows the names.
"""

import base64
from collections.abc import Iterator
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.cameras import Camera
from bevcli.geometry.transforms import Array, Pose, rigid
from bevcli.parsing.documents import LARGEST_INTEGER
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
    for transform in message.transforms if hasattr(message, "transforms") else (message,):
        parent = frame_of(transform) if hasattr(transform, "transform") else str(transform.parent_frame_id).lstrip("/")
        child, inner = str(transform.child_frame_id).lstrip("/"), getattr(transform, "transform", transform)
        yield Transform(parent, child, timestamp_ns(transform), _pose(inner.translation, inner.rotation))


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
