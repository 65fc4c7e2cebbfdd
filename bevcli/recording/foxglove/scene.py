"""Frames and boxes as the fields of ROS 2 and Foxglove messages."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import Camera
from bevcli.geometry.object_classes import Color
from bevcli.geometry.transforms import Array, Pose
from bevcli.recording.colors import GROUND_TRUTH_COLOR, OTHER_COLOR

Fields = dict[str, Any]
FONT_M = 0.6
DELETE_ALL = 1  # SceneEntityDeletion.type
LENSES = {4: "plumb_bob", 5: "plumb_bob", 8: "rational_polynomial"}  # number of Brown-Conrady coefficients


def header(time_ns: int, frame: str) -> Fields:
    """std_msgs/Header."""
    return {"stamp": stamp(time_ns), "frame_id": frame}


def stamp(time_ns: int) -> Fields:
    """builtin_interfaces/Time."""
    seconds, rest = divmod(time_ns, 10**9)
    return {"sec": seconds, "nanosec": rest}


def transform(time_ns: int, parent: str, child: str, pose: Pose) -> Fields:
    """geometry_msgs/TransformStamped. pose: parent_from_child."""
    inner = {"translation": _xyz(pose.translation), "rotation": _wxyz(pose.quaternion)}
    return {"header": header(time_ns, parent), "child_frame_id": child, "transform": inner}


def odometry(time_ns: int, parent: str, child: str, pose: Pose, velocity: Array, angular_rate: Array) -> Fields:
    """nav_msgs/Odometry. velocity, angular_rate: (3,) in the child frame, m/s and rad/s."""
    return {
        "header": header(time_ns, parent),
        "child_frame_id": child,
        "pose": {"pose": {"position": _xyz(pose.translation), "orientation": _wxyz(pose.quaternion)}},
        "twist": {"twist": {"linear": _xyz(velocity), "angular": _xyz(angular_rate)}},
    }


def camera_info(time_ns: int, frame: str, camera: Camera) -> Fields:
    """sensor_msgs/CameraInfo."""
    lens, k = camera.distortion, camera.intrinsics
    coefficients = [0.0] * 5 if lens is None else list(lens.coefficients)
    fisheye = lens is not None and lens.model == "kannala_brandt"
    model = "equidistant" if fisheye else LENSES.get(len(coefficients), "rational_polynomial")
    if model == "plumb_bob":
        coefficients += [0.0] * (5 - len(coefficients))
    return {
        "header": header(time_ns, frame),
        "height": camera.height,
        "width": camera.width,
        "distortion_model": model,
        "d": coefficients,
        "k": k.ravel(),
        "r": np.eye(3).ravel(),
        "p": np.column_stack([k, np.zeros(3)]).ravel(),
    }


def scene_update(time_ns: int, frame: str, boxes: Boxes3D, colors: Mapping[str, Color]) -> Fields:
    """foxglove_msgs/SceneUpdate that replaces all boxes of the topic. Boxes without scores are ground truth.

    colors: of the classes of predictions.
    """
    entities = [_entity(time_ns, frame, boxes, place, colors) for place in range(len(boxes))]
    return {"deletions": [{"timestamp": stamp(time_ns), "type": DELETE_ALL}], "entities": entities}


def _entity(time_ns: int, frame: str, boxes: Boxes3D, place: int, colors: Mapping[str, Color]) -> Fields:
    name, score = str(boxes.classes[place]), None if boxes.scores is None else float(boxes.scores[place])
    identity = "" if boxes.instances is None else str(boxes.instances[place])
    red, green, blue = GROUND_TRUTH_COLOR if score is None else colors.get(name, OTHER_COLOR)
    color = {"r": red / 255, "g": green / 255, "b": blue / 255, "a": 0.5}
    center, size, yaw = boxes.centers[place], boxes.sizes_lwh[place], float(boxes.yaws[place])
    turned = _wxyz([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)])
    velocity = boxes.velocities[place]
    facts = {"class": name, "track": identity, "score": "" if score is None else f"{score:.4f}"}
    facts |= {"vx": f"{velocity[0]:.3f}", "vy": f"{velocity[1]:.3f}"} if np.isfinite(velocity).all() else {}
    label = {
        "pose": {"position": _xyz(center + (0, 0, size[2] / 2 + FONT_M)), "orientation": _wxyz([1, 0, 0, 0])},
        "billboard": True,
        "font_size": FONT_M,
        "color": color | {"a": 1.0},
        "text": name if score is None else f"{name} {score:.2f}",
    }
    return {
        "timestamp": stamp(time_ns),
        "frame_id": frame,
        "id": str(place),  # identities may repeat: duplicates have those of their object
        "metadata": [{"key": key, "value": value} for key, value in facts.items() if value],
        "cubes": [{"pose": {"position": _xyz(center), "orientation": turned}, "size": _xyz(size), "color": color}],
        "texts": [label],
    }


def _xyz(values: Any) -> Fields:
    return dict(zip("xyz", map(float, values), strict=True))


def _wxyz(values: Any) -> Fields:
    return dict(zip("wxyz", map(float, values), strict=True))
