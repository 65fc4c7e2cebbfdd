"""The message types that are used, and their fields as this package's types.

ROS messages and Foxglove's schemas (in CDR, JSON or Protobuf) name the same things differently; this is the one place
that knows the names.
"""

from __future__ import annotations

import base64
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.cameras import Distortion
from bevcli.geometry.transforms import Array, Pose

Kind = Literal["image", "video", "calibration", "transforms", "pose"]
# The types by what they are used for; names without "msg/", and "foxglove" for foxglove_msgs, too.
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
    "geometry_msgs/PoseStamped": "pose",
    "geometry_msgs/PoseWithCovarianceStamped": "pose",
    "foxglove/PoseInFrame": "pose",
}
LENSES = {
    "plumb_bob": "brown_conrady",
    "rational_polynomial": "brown_conrady",
    "equidistant": "kannala_brandt",
    "kannala_brandt": "kannala_brandt",
    "fisheye": "kannala_brandt",
}
COEFFICIENT_COUNTS = {"brown_conrady": (4, 5, 8), "kannala_brandt": (4,)}


def short_type(name: str) -> str:
    """The name of a type as in KINDS: "sensor_msgs/msg/Image" -> "sensor_msgs/Image"."""
    return name.replace("/msg/", "/").replace("foxglove_msgs/", "foxglove/").replace("foxglove.", "foxglove/")


@dataclass(frozen=True)
class Transform:
    """A transform between two frames at a time.

    Attributes:
        parent: name of the parent frame.
        child: name of the child frame.
        timestamp_ns: 0 if it is not stated.
        parent_from_child: the pose of the child.
    """

    parent: str
    child: str
    timestamp_ns: int
    parent_from_child: Pose


@dataclass(frozen=True)
class CameraInfo:
    """The intrinsics of a camera.

    Attributes:
        frame: name of the camera's optical frame.
        width, height: of the image, pixels.
        intrinsics: (3, 3) of the image as it was taken, pixels.
        distortion: of the image as it was taken; None without.
        rectified_intrinsics: (3, 3) of the rectified image, pixels. None if they are not stated.
        rectified_from_camera: (3, 3) rotation from the camera's frame to the one of the rectified image.
    """

    frame: str
    width: int
    height: int
    intrinsics: Array
    distortion: Distortion | None
    rectified_intrinsics: Array | None
    rectified_from_camera: Array


def timestamp_ns(message: Any) -> int:
    """The time that a message states, ns; 0 if it states none."""
    header = getattr(message, "header", None)
    stamp = header.stamp if header is not None else getattr(message, "timestamp", None)
    if stamp is None:
        return 0
    seconds = _first(stamp, "sec", "seconds")
    return int(seconds) * 1_000_000_000 + int(_first(stamp, "nanosec", "nsec", "nanos", "nanoseconds"))


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
    """The transforms of a message: TFMessage, TransformStamped, FrameTransform or FrameTransforms."""
    parts = message.transforms if hasattr(message, "transforms") else (message,)
    for part in parts:
        if hasattr(part, "transform"):
            parent, child, inner = frame_of(part), part.child_frame_id, part.transform
        else:
            parent, child, inner = part.parent_frame_id, part.child_frame_id, part
        yield Transform(
            str(parent).lstrip("/"),
            str(child).lstrip("/"),
            timestamp_ns(part),
            _pose(inner.translation, inner.rotation),
        )


def pose_of(message: Any) -> Transform:
    """The pose that a message states: Odometry, PoseStamped, PoseWithCovarianceStamped or PoseInFrame.

    `child` is "" where the message does not name the frame.
    """
    inner = message.pose.pose if hasattr(message.pose, "pose") else message.pose
    child = str(getattr(message, "child_frame_id", "")).lstrip("/")
    return Transform(frame_of(message), child, timestamp_ns(message), _pose(inner.position, inner.orientation))


def camera_info_of(message: Any, where: str) -> CameraInfo:
    """The intrinsics in a CameraInfo or CameraCalibration. where: start of an error message.

    Raises InputError if they are not set or have an unknown distortion model.
    """
    binning = [max(1, int(getattr(message, name, 1) or 1)) for name in ("binning_x", "binning_y")]
    scale = np.diag([1 / binning[0], 1 / binning[1], 1.0])
    intrinsics = scale @ _matrix(_first(message, "k", "K"), 3, 3)
    if not (intrinsics[0, 0] > 0 and intrinsics[1, 1] > 0):
        raise InputError(f"{where}: the camera is not calibrated (K is zero): pass --calibration FILE")
    projection = _matrix(_first(message, "p", "P"), 3, 4)
    rotation = _matrix(_first(message, "r", "R"), 3, 3)
    return CameraInfo(
        frame_of(message),
        int(message.width) // binning[0],
        int(message.height) // binning[1],
        intrinsics,
        _distortion(str(message.distortion_model), [float(d) for d in _first(message, "d", "D")], where),
        scale @ projection[:, :3] if projection[0, 0] > 0 else None,
        rotation if abs(np.linalg.det(rotation) - 1) < 1e-3 else np.eye(3),
    )


def _distortion(model: str, coefficients: list[float], where: str) -> Distortion | None:
    if not any(coefficients):
        return None
    known = LENSES.get(model.lower() or "plumb_bob")
    if known is None:
        raise InputError(f"{where}: distortion model {model} is not supported (expected {', '.join(LENSES)})")
    counts = COEFFICIENT_COUNTS[known]
    if known == "brown_conrady" and len(coefficients) > 8 and not any(coefficients[8:]):
        coefficients = coefficients[:8]
    if len(coefficients) not in counts:
        expected = " or ".join(map(str, counts))
        raise InputError(f"{where}: {model} has {len(coefficients)} coefficients (expected {expected})")
    return Distortion(known, tuple(coefficients))  # type: ignore[arg-type]


def _pose(translation: Any, rotation: Any) -> Pose:
    quaternion = np.array([rotation.w, rotation.x, rotation.y, rotation.z], dtype=np.float64)
    norm = float(np.linalg.norm(quaternion))
    if not 0.9 < norm < 1.1:
        raise ValueError(f"a rotation is not a quaternion of norm 1, its norm is {norm:.3g}")
    return Pose(np.array([translation.x, translation.y, translation.z], dtype=np.float64), quaternion / norm)


def _matrix(values: Any, rows: int, columns: int) -> Array:
    numbers = np.array(list(values), dtype=np.float64)
    return numbers.reshape(rows, columns) if numbers.size == rows * columns else np.zeros((rows, columns))


def _first(owner: Any, *names: str) -> Any:
    """The first of several attributes that an object has. Protobuf and ROS write the same fields differently."""
    for name in names:
        if hasattr(owner, name):
            return getattr(owner, name)
    raise ValueError(f"the field {names[0]} is missing")
