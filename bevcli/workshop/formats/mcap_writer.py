"""Writes a drive as an MCAP file of ROS 2 messages, with boxes as Foxglove scenes."""

from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

import numpy as np
from mcap.writer import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from bevcli.errors import InputError, OutputError
from bevcli.frame import CameraImage, Drive, Frame
from bevcli.geometry.boxes import Boxes3D
from bevcli.geometry.cameras import Camera, CameraRig
from bevcli.geometry.object_classes import NUSCENES_CLASSES, Color
from bevcli.geometry.transforms import Array, Pose
from bevcli.recording.entities import GROUND_TRUTH_COLOR, OTHER_COLOR, class_colors
from bevcli.sequences.files.boxes_file import BoxesFile, above_score, read_boxes
from bevcli.workshop.formats import WriteOptions
from bevcli.workshop.formats.output import image_file
from bevcli.writing import check_output, whole_file

# The fields of foxglove_msgs as they stand in a CDR message; POSE, COLOR and POINTS are short for their types.
FOXGLOVE = {
    "SceneUpdate": "SceneEntityDeletion[] deletions, SceneEntity[] entities",
    "SceneEntityDeletion": "TIME timestamp, uint8 type, string id",
    "SceneEntity": "TIME timestamp, string frame_id, string id, builtin_interfaces/Duration lifetime, "
    "bool frame_locked, KeyValuePair[] metadata, ArrowPrimitive[] arrows, CubePrimitive[] cubes, "
    "SpherePrimitive[] spheres, CylinderPrimitive[] cylinders, LinePrimitive[] lines, "
    "TriangleListPrimitive[] triangles, TextPrimitive[] texts, ModelPrimitive[] models",
    "KeyValuePair": "string key, string value",
    "Color": "float64 r, float64 g, float64 b, float64 a",
    "ArrowPrimitive": "POSE pose, float64 shaft_length, float64 shaft_diameter, float64 head_length, "
    "float64 head_diameter, Color color",
    "CubePrimitive": "POSE pose, VECTOR size, Color color",
    "SpherePrimitive": "POSE pose, VECTOR size, Color color",
    "CylinderPrimitive": "POSE pose, VECTOR size, float64 bottom_scale, float64 top_scale, Color color",
    "LinePrimitive": "uint8 type, POSE pose, float64 thickness, bool scale_invariant, POINT[] points, Color color, "
    "Color[] colors, uint32[] indices",
    "TriangleListPrimitive": "POSE pose, POINT[] points, Color color, Color[] colors, uint32[] indices",
    "TextPrimitive": "POSE pose, bool billboard, float64 font_size, bool scale_invariant, Color color, string text",
    "ModelPrimitive": "POSE pose, VECTOR scale, Color color, bool override_color, string url, string media_type, "
    "uint8[] data",
}
SHORT = {
    "TIME": "builtin_interfaces/Time",
    "POSE": "geometry_msgs/Pose",
    "POINT": "geometry_msgs/Point",
    "VECTOR": "geometry_msgs/Vector3",
    **{name: f"foxglove_msgs/{name}" for name in FOXGLOVE},
}
NAME, ARRAY, SEQUENCE = 2, 3, 4  # kinds of fields in rosbags
Fields = dict[str, Any]  # of a message of ROS 2 or Foxglove
WORLD, EGO, BEV = "map", "base_link", "bev"
FONT_M = 0.6
DELETE_ALL = 1  # SceneEntityDeletion.type
LENSES = {4: "plumb_bob", 5: "plumb_bob", 8: "rational_polynomial"}  # number of Brown-Conrady coefficients


class Messages:
    """Encodes messages. Types are named as "sensor_msgs/CameraInfo"."""

    def __init__(self) -> None:
        self._store = get_typestore(Stores.ROS2_HUMBLE)
        for name, fields in FOXGLOVE.items():
            text = "\n".join(_long(field) for field in fields.split(", "))
            self._store.register(get_types_from_msg(text, f"foxglove_msgs/msg/{name}"))

    def definition(self, type_name: str) -> str:
        """The definition of a type, with those of all types that it contains."""
        return str(self._store.generate_msgdef(_full(type_name), ros_version=2)[0])

    def encode(self, type_name: str, fields: dict[str, Any]) -> bytes:
        """The CDR bytes of a message. Fields that are left out are zero or empty."""
        return bytes(self._store.serialize_cdr(self._message(_full(type_name), fields), _full(type_name)))

    def _message(self, name: str, fields: dict[str, Any]) -> Any:
        kinds = dict(self._store.fielddefs[name][1])
        assert fields.keys() <= kinds.keys(), (name, fields.keys())
        return self._store.types[name](**{key: self._value(entry, fields.get(key)) for key, entry in kinds.items()})

    def _value(self, field_type: Any, value: Any) -> Any:
        node, detail = int(field_type[0]), field_type[1]
        if node == NAME:
            return self._message(detail, value or {})
        if node not in (ARRAY, SEQUENCE):
            empty = "" if detail[0] == "string" else 0
            return empty if value is None else value
        (inner, element), count = detail
        if int(inner) == NAME:
            return [self._message(element, item) for item in value or ()]
        if isinstance(value, bytes):
            return np.frombuffer(value, dtype=np.uint8)
        return np.array(np.zeros(count if node == ARRAY else 0) if value is None else value, dtype=element[0])


def _long(field: str) -> str:
    type_name, _, name = field.partition(" ")
    plain = type_name.removesuffix("[]")
    return f"{SHORT.get(plain, plain)}{type_name[len(plain) :]} {name}"


def _full(type_name: str) -> str:
    return type_name.replace("/", "/msg/")


class McapWriter:
    """Writes an MCAP file frame by frame; it gets its name when it is whole.

    Topics: /CAMERA/image/compressed, /CAMERA/camera_info, /tf_static (cameras and the bev frame in base_link), /tf and
    /odom (base_link in map), /ground_truth and, with `boxes`, /predictions. The bytes of JPEG and PNG files are kept;
    other images become PNG.
    """

    def __init__(self, path: Path, sequence: Drive, options: WriteOptions) -> None:
        """Raises InputError for boxes of another drive, and OutputError."""
        if path.exists() and not options.force:
            raise OutputError(
                f"{path}: exists already: choose another file, or pass `force=True` (`--force`) to replace it"
            )
        self.path, self._has_ego_motion = path, sequence.has_ego_motion
        self._boxes = None if options.boxes is None else _boxes_of(options.boxes, options.score, sequence, path)
        classes = None if self._boxes is None else self._boxes.classes
        self._colors = class_colors((classes or NUSCENES_CLASSES).values())
        frames = () if self._boxes is None else self._boxes.frames
        self._frames = {frame.stamp: frame for frame in frames}
        self._rig: CameraRig | None = None
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._open = ExitStack()

    def __enter__(self) -> Self:
        self._messages = Messages()
        file = self._open.enter_context(whole_file(self.path, parents=True))
        self._writer = Writer(self._open.enter_context(file.open("wb")))
        self._writer.start(profile="ros2", library="bevcli")
        return self

    def __exit__(self, error_type: type[BaseException] | None, *error: Any) -> None:
        if error_type is not None:
            self._open.__exit__(error_type, *error)
            return
        with self._open:
            if self._rig is None:
                raise OutputError(f"{self.path}: no frame was written (expected at least one)")
            self._writer.finish()

    def write(self, frame: Frame) -> None:
        """Write a frame: its poses, images, calibrations and boxes."""
        time_ns = frame.stamp.timestamp_ns
        if frame.rig is not self._rig:
            self._write_rig(frame.rig, time_ns)
        if self._has_ego_motion:
            self._write_poses(frame)
        for name, image in frame.images.items():
            self._write_image(frame, name, image)
        fixed = WORLD if self._has_ego_motion else EGO
        shown = {"/ground_truth": frame.ground_truth, "/predictions": self._predicted(frame)}
        for topic, boxes in shown.items():
            if boxes is not None:
                fields = scene_update(time_ns, fixed, boxes, self._colors)
                self._add(topic, "foxglove_msgs/SceneUpdate", time_ns, fields)

    def _write_rig(self, rig: CameraRig, time_ns: int) -> None:
        poses = {_optical(camera.name): camera.ego_from_camera for camera in rig.cameras} | {BEV: rig.ego_from_bev}
        transforms = [transform(time_ns, EGO, name, Pose.from_matrix(pose)) for name, pose in poses.items()]
        self._add("/tf_static", "tf2_msgs/TFMessage", time_ns, {"transforms": transforms})
        self._rig = rig

    def _write_poses(self, frame: Frame) -> None:
        """The vehicle's poses at the times of the frame and its images; those at one time are written once."""
        motion = frame.kinematics
        poses = {image.timestamp_ns: frame.world_from_ego_at[name] for name, image in frame.images.items()}
        poses[frame.stamp.timestamp_ns] = frame.world_from_ego
        for time_ns, pose in sorted(poses.items()):
            moved = transform(time_ns, WORLD, EGO, pose)
            self._add("/tf", "tf2_msgs/TFMessage", time_ns, {"transforms": [moved]})
            fields = odometry(time_ns, WORLD, EGO, pose, motion.velocity, motion.angular_rate)
            self._add("/odom", "nav_msgs/Odometry", time_ns, fields)

    def _write_image(self, frame: Frame, name: str, image: CameraImage) -> None:
        time_ns, (content, form) = image.timestamp_ns, image_file(image)
        fields = {"header": header(time_ns, _optical(name)), "format": form, "data": content}
        self._add(f"/{name}/image/compressed", "sensor_msgs/CompressedImage", time_ns, fields)
        info = camera_info(time_ns, _optical(name), frame.rig[name])
        self._add(f"/{name}/camera_info", "sensor_msgs/CameraInfo", time_ns, info)

    def _predicted(self, frame: Frame) -> Boxes3D | None:
        """The run's boxes of a frame, in the frame of the scene; none where the run does not have the frame."""
        if self._boxes is None:
            return None
        predicted = self._frames.get(frame.stamp)
        if predicted is None:
            return Boxes3D.empty()
        in_ego = self._boxes.in_ego(predicted)
        return in_ego.transformed(frame.world_from_ego.matrix) if self._has_ego_motion else in_ego

    def _add(self, topic: str, type_name: str, time_ns: int, fields: Fields) -> None:
        if type_name not in self._schemas:
            text = self._messages.definition(type_name).encode()
            self._schemas[type_name] = self._writer.register_schema(type_name.replace("/", "/msg/"), "ros2msg", text)
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(topic, "cdr", self._schemas[type_name])
        data = self._messages.encode(type_name, fields)
        self._writer.add_message(self._channels[topic], log_time=time_ns, publish_time=time_ns, data=data)


def _boxes_of(run: Path, score: float, sequence: Drive, out: Path) -> BoxesFile:
    file = run / "predictions.json" if run.is_dir() else run
    check_output(out, file)
    boxes = above_score(read_boxes(file), score)
    if not {frame.stamp for frame in boxes.frames} & set(sequence.stamps):
        raise InputError(f"{file}: has none of the frames of {sequence.name}: convert the drive that the run is of")
    return boxes


def _optical(camera: str) -> str:
    return f"{camera}_optical"


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
    entities = [_entity(time_ns, frame, boxes, index, colors) for index in range(len(boxes))]
    return {"deletions": [{"timestamp": stamp(time_ns), "type": DELETE_ALL}], "entities": entities}


def _entity(time_ns: int, frame: str, boxes: Boxes3D, index: int, colors: Mapping[str, Color]) -> Fields:
    name, score = str(boxes.classes[index]), None if boxes.scores is None else float(boxes.scores[index])
    identity = "" if boxes.instances is None else str(boxes.instances[index])
    red, green, blue = GROUND_TRUTH_COLOR if score is None else colors.get(name, OTHER_COLOR)
    color = {"r": red / 255, "g": green / 255, "b": blue / 255, "a": 0.5}
    center, size, yaw = boxes.centers[index], boxes.sizes_lwh[index], float(boxes.yaws[index])
    turned = _wxyz([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)])
    velocity = boxes.velocities[index]
    properties = {"class": name, "track": identity, "score": "" if score is None else f"{score:.4f}"}
    properties |= {"vx": f"{velocity[0]:.3f}", "vy": f"{velocity[1]:.3f}"} if np.isfinite(velocity).all() else {}
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
        "id": str(index),  # identities may repeat: duplicates have those of their object
        "metadata": [{"key": key, "value": value} for key, value in properties.items() if value],
        "cubes": [{"pose": {"position": _xyz(center), "orientation": turned}, "size": _xyz(size), "color": color}],
        "texts": [label],
    }


def _xyz(values: Any) -> Fields:
    return dict(zip("xyz", map(float, values), strict=True))


def _wxyz(values: Any) -> Fields:
    return dict(zip("wxyz", map(float, values), strict=True))
