"""Labels of CVAT: the cuboids of a 3D task, exported as "Datumaro 3D"."""

from pathlib import Path

import msgspec
import numpy as np

from bevcli.errors import InputError
from bevcli.geometry.boxes import Boxes3D
from bevcli.parsing.files import MIB, read_bytes
from bevcli.sequences.labels.label_format import LabelFormat, LabelledFrame, Labels, is_json_with, tilt_note

LARGEST_BYTES = 1024 * MIB
CUBOID = "cuboid_3d"


class _Annotation(msgspec.Struct):
    type: str
    label_id: int | None = None
    position: list[float] = []
    rotation: list[float] = []  # radians about x, y and z: Rx Ry Rz
    scale: list[float] = []  # length, width, height
    attributes: dict[str, str | int | float | bool | None] = {}


class _Attributes(msgspec.Struct):
    frame: int | None = None


class _Item(msgspec.Struct):
    id: str
    attr: _Attributes = msgspec.field(default_factory=_Attributes)
    annotations: list[_Annotation] = []


class _Label(msgspec.Struct):
    name: str


class _Labels(msgspec.Struct):
    labels: list[_Label]


class _Categories(msgspec.Struct):
    label: _Labels


class _File(msgspec.Struct):
    categories: _Categories
    items: list[_Item]


def read_cvat_labels(path: Path) -> Labels:
    """The cuboids of annotations/default.json in the exported archive. Tracks are instances. Raises InputError.

    CVAT's cuboids are in the frame of the point cloud, which is taken to be the ego frame.
    """
    try:
        content = msgspec.json.decode(read_bytes(path, LARGEST_BYTES), type=_File)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise InputError(f'{path}: is not a CVAT export "Datumaro 3D": {error}') from None
    classes = [label.name for label in content.categories.label.labels]
    frames = tuple(_frame(path, item, classes) for item in content.items)
    tilts = [_tilt(one) for item in content.items for one in item.annotations if one.type == CUBOID]
    note = 'the cuboids are taken to be in the "ego" frame: that of the point clouds that were labelled'
    return Labels("ego", frames, lists_empty=True, notes=(note, *tilt_note(tilts)))


def _frame(path: Path, item: _Item, classes: list[str]) -> LabelledFrame:
    where = f"{path}: item {item.id:.40}"
    if item.attr.frame is None:
        raise InputError(f'{where}: "attr" has no "frame", the index of the frame')
    boxes = [_box(where, one, classes) for one in item.annotations if one.type == CUBOID]
    return LabelledFrame(item.attr.frame, None, Boxes3D.concatenate(boxes))


def _box(where: str, cuboid: _Annotation, classes: list[str]) -> Boxes3D:
    numbers = np.array([*cuboid.position, *cuboid.rotation, *cuboid.scale])
    if [len(each) for each in (cuboid.position, cuboid.rotation, cuboid.scale)] != [3, 3, 3] or not (
        np.isfinite(numbers).all() and numbers[-3:].min() > 0
    ):
        raise InputError(f"{where}: expected cuboids with three numbers each of position, rotation and scale, above 0")
    if cuboid.label_id is None or not 0 <= cuboid.label_id < len(classes):
        raise InputError(
            f'{where}: label_id is {cuboid.label_id} (expected 0 to {len(classes) - 1}, from "categories")'
        )
    (sx, sy, sz), (cx, cy, cz) = np.sin(cuboid.rotation), np.cos(cuboid.rotation)
    track = cuboid.attributes.get("track_id")
    return Boxes3D(
        numbers[None, :3], numbers[None, -3:], np.array([np.arctan2(cx * sz + sx * sy * cz, cy * cz)]),
        np.full((1, 2), np.nan), np.array([classes[cuboid.label_id]]),
        instances=np.array(["" if track is None else str(track)]),
    )  # fmt: skip


def _tilt(cuboid: _Annotation) -> float:
    """Angle between the cuboid's vertical and that of the frame, degrees."""
    return float(np.degrees(np.arccos(np.prod(np.cos(cuboid.rotation[:2])))))


FORMAT = LabelFormat(
    'a CVAT export "Datumaro 3D" (annotations/default.json)',
    lambda path: is_json_with(path, '"categories"'),
    lambda path, rig, options: read_cvat_labels(path),
)
