"""ROS 2 messages in CDR, from nested dictionaries; those of Foxglove's package foxglove_msgs among them."""

from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

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


class Messages:
    """Encodes messages. Types are named as "sensor_msgs/CameraInfo"."""

    def __init__(self) -> None:
        self._store = get_typestore(Stores.ROS2_HUMBLE)
        for name, fields in FOXGLOVE.items():
            text = "\n".join(_long(field) for field in fields.split(", "))
            self._store.register(get_types_from_msg(text, f"foxglove_msgs/msg/{name}"))

    def definition(self, kind: str) -> str:
        """The definition of a type, with those of all types that it contains."""
        return str(self._store.generate_msgdef(_full(kind), ros_version=2)[0])

    def encode(self, kind: str, fields: dict[str, Any]) -> bytes:
        """The CDR bytes of a message. Fields that are left out are zero or empty."""
        return bytes(self._store.serialize_cdr(self._message(_full(kind), fields), _full(kind)))

    def _message(self, name: str, fields: dict[str, Any]) -> Any:
        kinds = dict(self._store.fielddefs[name][1])
        assert fields.keys() <= kinds.keys(), (name, fields.keys())
        return self._store.types[name](**{key: self._value(kind, fields.get(key)) for key, kind in kinds.items()})

    def _value(self, kind: Any, value: Any) -> Any:
        node, detail = int(kind[0]), kind[1]
        if node == NAME:
            return self._message(detail, value or {})
        if node not in (ARRAY, SEQUENCE):
            empty = "" if detail[0] == "string" else 0
            return empty if value is None else value
        (inner, element), count = detail
        if int(inner) == NAME:
            return [self._message(element, one) for one in value or ()]
        if isinstance(value, bytes):
            return np.frombuffer(value, dtype=np.uint8)
        return np.array(np.zeros(count if node == ARRAY else 0) if value is None else value, dtype=element[0])


def _long(field: str) -> str:
    kind, _, name = field.partition(" ")
    plain = kind.removesuffix("[]")
    return f"{SHORT.get(plain, plain)}{kind[len(plain) :]} {name}"


def _full(kind: str) -> str:
    return kind.replace("/", "/msg/")
