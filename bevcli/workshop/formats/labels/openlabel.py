"""Labels in ASAM OpenLABEL 1.0.0: cuboids of objects by frame."""

from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.boxes import Boxes3D
from bevcli.workshop.formats.labels.cuboid import Cuboid, labels_of_cuboids
from bevcli.workshop.formats.labels.label_format import (
    FrameOfReference,
    LabelFormat,
    Labels,
    Moment,
    decoded,
    starts_with,
)

# Names of coordinate systems -> our frames; those with other names need a transform, which is not read.
SYSTEMS: Mapping[str, FrameOfReference] = {
    "world": "world", "odom": "world", "ego": "ego", "vehicle-iso8855": "ego", "bev": "bev",
}  # fmt: skip


class _Value(msgspec.Struct):
    name: str
    val: Any


class _Attributes(msgspec.Struct):
    num: list[_Value] = []
    text: list[_Value] = []


class _Cuboid(msgspec.Struct):
    val: list[float]
    coordinate_system: str = "ego"
    attributes: _Attributes = msgspec.field(default_factory=_Attributes)


class _Data(msgspec.Struct):
    cuboid: list[_Cuboid] = []


class _ObjectInFrame(msgspec.Struct):
    object_data: _Data = msgspec.field(default_factory=_Data)


class _Properties(msgspec.Struct):
    timestamp: str | int | float | None = None


class _Frame(msgspec.Struct):
    frame_properties: _Properties = msgspec.field(default_factory=_Properties)
    objects: dict[str, _ObjectInFrame] = {}


class _Object(msgspec.Struct):
    type: str


class _Content(msgspec.Struct):
    frames: dict[str, _Frame]
    objects: dict[str, _Object] = {}


class _File(msgspec.Struct):
    openlabel: _Content


def read_openlabel(path: Path) -> Labels:
    """The cuboids of a file. An object is a track. Raises InputError.

    Cuboids are in one of the coordinate systems world (or odom), ego (or vehicle-iso8855) or bev.
    """
    content = decoded(path, _File, "OpenLABEL").openlabel
    found = [each for frame in content.frames.values() for each in frame.objects.values()]
    systems = {one.coordinate_system for each in found for one in each.object_data.cuboid} or {"ego"}
    unknown = systems - SYSTEMS.keys()
    if unknown or len({SYSTEMS[name] for name in systems}) > 1:
        stated = ", ".join(sorted(systems))
        raise InputError(f"{path}: expected all cuboids in one of {', '.join(SYSTEMS)}, found {stated}")
    frames = (_frame(path, content, number, frame) for number, frame in content.frames.items())
    return labels_of_cuboids(SYSTEMS[systems.pop()], frames, lists_empty=True)


def _frame(path: Path, content: _Content, number: str, frame: _Frame) -> tuple[Moment, list[Cuboid]]:
    where = f"{path}: frame {number:.20}"
    if not number.isdecimal():
        raise InputError(f"{where}: expected a number")
    cuboids = []
    for key, found in frame.objects.items():
        if found.object_data.cuboid and key not in content.objects:
            raise InputError(f'{where}: object {key:.40} is not among "objects"')
        cuboids += [_cuboid(where, key, content.objects[key].type, one) for one in found.object_data.cuboid]
    return (int(number), _time_ns(where, frame.frame_properties.timestamp)), cuboids


def _cuboid(where: str, key: str, kind: str, cuboid: _Cuboid) -> Cuboid:
    """One cuboid. Its rotation is a quaternion x, y, z, w, or three angles about x, y and z."""
    values = np.array(cuboid.val, dtype=float)
    if values.shape not in ((10,), (9,)) or not np.isfinite(values).all():
        raise InputError(f"{where}: object {key:.40}: expected a cuboid of 10 or 9 numbers")
    x, y, z, w = values[3:7] if len(values) == 10 else _quaternion(*values[3:6])
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    tilt_deg = float(np.degrees(np.arccos(np.clip(1 - 2 * (x * x + y * y), -1, 1))))
    numbers = {one.name: one.val for one in cuboid.attributes.num if isinstance(one.val, int | float)}
    texts = {one.name: str(one.val) for one in cuboid.attributes.text}
    velocity = [numbers.get("vx", np.nan), numbers.get("vy", np.nan)]
    box = Boxes3D(
        values[None, :3], values[None, -3:], np.array([yaw]), np.array([velocity]), np.array([kind]),
        attributes=np.array([texts.get("attribute", "")]), instances=np.array([key]),
        visibilities=np.array([float(numbers.get("visibility", np.nan))]),
    )  # fmt: skip
    return Cuboid(box, tilt_deg)


def _quaternion(roll: float, pitch: float, yaw: float) -> tuple[float, float, float, float]:
    """x, y, z, w of the rotation by roll about x, then pitch about y, then yaw about z."""
    (a, b, c), (d, e, f) = np.sin(np.array([roll, pitch, yaw]) / 2), np.cos(np.array([roll, pitch, yaw]) / 2)
    return a * e * f - d * b * c, d * b * f + a * e * c, d * e * c - a * b * f, d * e * f + a * b * c


def _time_ns(where: str, stated: str | int | float | None) -> int | None:
    """Nanoseconds of a time: text as in ISO 8601, up to nanoseconds; none for another kind of number."""
    if not isinstance(stated, str):
        return None
    try:
        whole, _, fraction = stated.removesuffix("Z").partition(".")
        datetime.fromisoformat(whole)
        return int(np.datetime64(f"{whole}.{fraction or 0}", "ns").astype(np.int64))
    except ValueError:
        raise InputError(f'{where}: timestamp "{stated:.40}" is not a time such as 2026-01-31T12:00:00.5Z') from None


FORMAT = LabelFormat(
    "an OpenLABEL file (.json)",
    lambda path: starts_with(path, ".json", '"openlabel"'),
    lambda path, rig, options: read_openlabel(path),
)
