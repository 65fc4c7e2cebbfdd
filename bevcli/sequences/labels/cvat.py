"""Labels of CVAT: the cuboids of a 3D task, exported as "Datumaro 3D"."""

from pathlib import Path

import msgspec

from bevcli.errors import InputError
from bevcli.geometry.boxes import Boxes3D
from bevcli.parsing.files import MIB, read_bytes
from bevcli.sequences.labels.cuboid import IN_EGO, Cuboid, tilt_note
from bevcli.sequences.labels.label_format import LabelFormat, LabelledFrame, Labels, starts_with

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
    tilts: list[float] = []
    frames = tuple(_frame(path, item, classes, tilts) for item in content.items)
    return Labels("ego", frames, lists_empty=True, notes=(IN_EGO, *tilt_note(tilts)))


def _frame(path: Path, item: _Item, classes: list[str], tilts: list[float]) -> LabelledFrame:
    where = f"{path}: item {item.id:.40}"
    if item.attr.frame is None:
        raise InputError(f'{where}: "attr" has no "frame", the index of the frame')
    cuboids = [_cuboid(where, one, classes) for one in item.annotations if one.type == CUBOID]
    tilts += [one.tilt_deg for one in cuboids]
    return LabelledFrame(item.attr.frame, None, Boxes3D.concatenate(one.box() for one in cuboids))


def _cuboid(where: str, one: _Annotation, classes: list[str]) -> Cuboid:
    if one.label_id is None or not 0 <= one.label_id < len(classes):
        raise InputError(f'{where}: label_id is {one.label_id} (expected 0 to {len(classes) - 1}, from "categories")')
    track = one.attributes.get("track_id")
    name, identity = classes[one.label_id], "" if track is None else str(track)
    return Cuboid.checked(where, name, identity, one.position, one.rotation, one.scale)


FORMAT = LabelFormat(
    'a CVAT export "Datumaro 3D" (annotations/default.json)',
    lambda path: starts_with(path, ".json", '"categories"'),
    lambda path, rig, options: read_cvat_labels(path),
)
